from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from embomatrix.factory.floorplan.layout import FloorPlan, compactness, plan_floor
from embomatrix.factory.floorplan.spec import MIN_DOOR_M, FloorPlanError, OpeningSpec, RoomSpec
from embomatrix.factory.floorplan.walls import WALL_M
from embomatrix.factory.scenes.build import room_spec
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import Pose
from embomatrix.world.scene import ROOM_HEIGHT_M

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
ORIGIN = Pose((0.0, 0.0, 0.0))
BASE_SCENES = ("Rs_int", "Wainscott_0_int", "restaurant_diner")


def plan_of(scene_id: str, seed: int = 0) -> FloorPlan:
    catalog = Catalog.load()
    rooms = [room_spec(catalog, room) for room in catalog.inventory(scene_id).rooms]
    return plan_floor(rooms, np.random.default_rng(seed))


def reached(plan: FloorPlan) -> set[str]:
    """Return the rooms that doorways connect to the first one."""
    found = {plan.rooms[0].name}
    for _ in plan.rooms:
        for door in plan.doorways:
            if found & set(door.rooms):
                found |= {name for name in door.rooms if name}
    return found


def apart_m(a: object, b: object) -> float:
    """Return the gap between two rooms along their best separating axis; negative when they overlap."""
    return max(
        max(a.low_m[i] - b.high_m[i], b.low_m[i] - a.high_m[i])  # type: ignore[attr-defined]
        for i in (0, 1)
    )


@pytest.mark.parametrize("scene_id", BASE_SCENES)
def test_rooms_keep_their_size_and_lie_a_wall_apart(scene_id: str) -> None:
    plan = plan_of(scene_id)
    floors = {room.name: room.floor_m for room in Catalog.load().inventory(scene_id).rooms}
    for room in plan.rooms:
        assert sorted(room.size_m) == pytest.approx(sorted(floors[room.name]))
    for a, b in itertools.combinations(plan.rooms, 2):
        assert apart_m(a, b) >= WALL_M - 1e-6


@pytest.mark.parametrize("scene_id", BASE_SCENES)
def test_doorways_join_all_rooms_and_one_leads_outside(scene_id: str) -> None:
    plan = plan_of(scene_id)
    assert reached(plan) == {room.name for room in plan.rooms}
    assert [door.rooms[1] for door in plan.doorways].count("") == 1
    assert all(door.width_m >= MIN_DOOR_M - 1e-9 for door in plan.doorways)


@pytest.mark.parametrize("scene_id", BASE_SCENES)
def test_walls_stand_on_no_floor_and_leave_inner_doorways_open(scene_id: str) -> None:
    plan = plan_of(scene_id)
    boxes = [wall.aabb(ORIGIN) for wall in plan.walls]
    for room in plan.rooms:
        for box in boxes:
            covered = [min(box.high_m[i], room.high_m[i]) - max(box.low_m[i], room.low_m[i]) for i in (0, 1)]
            assert min(covered) < 1e-6
    for door in plan.doorways:
        blocked = any(box.contains((*door.center_m, 1.0)) for box in boxes)
        assert blocked == (door.rooms[1] == "")
        assert any(box.contains((*door.center_m, ROOM_HEIGHT_M - 0.05)) for box in boxes)


@pytest.fixture(scope="module")
def true_rooms() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the measured room corners of Beechwood_0_int."""
    path = DATA / "beechwood_0_int_layout.json"
    if not path.exists():
        pytest.skip("the measured layout of Beechwood_0_int lies beside the repository, in ../shared/data")
    rooms = json.loads(path.read_text())["rooms"]
    return {
        r["name"]: (
            np.subtract(r["center"], np.divide(r["size"], 2)),
            np.add(r["center"], np.divide(r["size"], 2)),
        )
        for r in rooms
    }


def test_plans_are_about_as_compact_as_the_real_one(
    true_rooms: dict[str, tuple[np.ndarray, np.ndarray]],
) -> None:
    low = np.min([low for low, _ in true_rooms.values()], axis=0)
    high = np.max([high for _, high in true_rooms.values()], axis=0)
    plan = plan_of("Beechwood_0_int")
    ours = np.max([r.high_m for r in plan.rooms], axis=0) - np.min([r.low_m for r in plan.rooms], axis=0)
    assert float(np.prod(ours)) < 1.2 * float(np.prod(high - low))
    assert compactness(plan.rooms) > 0.8


def test_doorways_join_rooms_adjacent_in_the_real_house_more_often_than_chance(
    true_rooms: dict[str, tuple[np.ndarray, np.ndarray]],
) -> None:
    def touch(a: str, b: str) -> bool:
        # walls are up to 0.4 m thick there; half a metre of common wall makes neighbours
        gap = np.maximum(true_rooms[a][0], true_rooms[b][0]) - np.minimum(true_rooms[a][1], true_rooms[b][1])
        return bool(gap.max() < 0.45 and gap.min() < -0.5)

    pairs = list(itertools.combinations(true_rooms, 2))
    chance = sum(touch(a, b) for a, b in pairs) / len(pairs)
    doorways = [door.rooms for seed in range(4) for door in plan_of("Beechwood_0_int", seed).doorways]
    inner = [rooms for rooms in doorways if all(rooms)]
    assert sum(touch(*rooms) for rooms in inner) / len(inner) > 1.2 * chance


def test_equal_seeds_give_equal_plans() -> None:
    assert plan_of("Rs_int", 3) == plan_of("Rs_int", 3)
    assert any(plan_of("Rs_int", 3) != plan_of("Rs_int", other) for other in (4, 5, 6))


def test_inner_door_is_removed_from_both_rooms_that_list_it() -> None:
    wide = OpeningSpec("wide", 1.5, 2.0)
    rooms = [
        RoomSpec("kitchen_0", "kitchen", (3, 3), (wide,)),
        RoomSpec("dining_room_0", "dining_room", (4, 3), (wide,)),
    ]
    plan = plan_floor(rooms, np.random.default_rng(0))
    inner = [door for door in plan.doorways if door.rooms[1]]
    assert [(door.model, door.width_m) for door in inner] == [("wide", pytest.approx(1.5))]


def test_suite_is_entered_by_its_bedroom() -> None:
    front, cabin = OpeningSpec("front", 0.9, 2.0), OpeningSpec("cabin", 0.9, 2.0)
    rooms = [
        RoomSpec("bathroom_0", "bathroom", (3, 3), (cabin,)),
        RoomSpec("bedroom_0", "bedroom", (4, 4), (front,)),
    ]
    plan = plan_floor(rooms, np.random.default_rng(0), trials=4)
    assert (plan.doorways[-1].rooms, plan.doorways[-1].model) == (("bedroom_0", ""), "front")


def test_plan_without_rooms_is_rejected() -> None:
    with pytest.raises(FloorPlanError, match="at least one"):
        plan_floor([], np.random.default_rng(0))


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.tuples(st.floats(1.0, 9.0), st.floats(1.0, 9.0)), min_size=1, max_size=7),
    st.integers(0, 2**32 - 1),
)
def test_any_rooms_are_packed_without_overlap_and_connected(
    floors: list[tuple[float, float]], seed: int
) -> None:
    types = ("corridor", "bedroom", "kitchen", "bathroom", "living_room", "storage_room", "garage")
    rooms = [RoomSpec(f"room_{i}", types[i], floor) for i, floor in enumerate(floors)]
    plan = plan_floor(rooms, np.random.default_rng(seed), trials=6)
    assert all(apart_m(a, b) >= WALL_M - 1e-6 for a, b in itertools.combinations(plan.rooms, 2))
    assert reached(plan) == {room.name for room in plan.rooms}
