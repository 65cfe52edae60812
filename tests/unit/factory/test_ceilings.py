"""Ceilings fit their rooms, and whatever hangs there clears people's heads."""

from __future__ import annotations

import pytest

from embomatrix.factory.evaluate.furnishing import furnishing_counts
from embomatrix.factory.floorplan.ceilings import HEAD_ROOM_M, HOME_M, ceiling_height_m
from embomatrix.factory.floorplan.walls import Rect, build_walls
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.world.codec import scene_from_json, scene_to_json
from embomatrix.world.geometry import IDENTITY
from embomatrix.world.scene import ROOM_HEIGHT_M


@pytest.mark.parametrize(
    ("room_type", "floor_m", "low_m", "high_m"),
    [
        ("bedroom", (4.0, 4.0), HOME_M, HOME_M),
        ("gym", (33.0, 39.0), 6.0, 9.0),
        ("classroom", (8.0, 9.0), 3.0, 3.5),
        ("corridor", (10.0, 33.0), 3.5, 4.0),
        ("garden", (30.0, 40.0), ROOM_HEIGHT_M, ROOM_HEIGHT_M),
    ],
)
def test_height_follows_type_and_area(
    room_type: str, floor_m: tuple[float, float], low_m: float, high_m: float
) -> None:
    assert low_m <= ceiling_height_m(room_type, floor_m) <= high_m


@pytest.mark.parametrize(("hanging_m", "floor_m"), [(1.1, (4.0, 4.0)), (2.6, (15.0, 20.0))])
def test_lamp_raises_the_ceiling_until_heads_are_clear(
    hanging_m: float, floor_m: tuple[float, float]
) -> None:
    height = ceiling_height_m("dining_room", floor_m, [0.2, hanging_m])
    assert HEAD_ROOM_M <= height - hanging_m < HEAD_ROOM_M + 0.2


def test_lamp_beyond_any_ceiling_does_not_raise_it() -> None:
    assert ceiling_height_m("bedroom", (4.0, 4.0), [3.0]) == HOME_M


def test_wall_between_two_rooms_has_the_height_of_the_higher_one() -> None:
    rects = {"low": Rect(0.0, 0.0, 4.0, 4.0), "high": Rect(4.0, 0.0, 9.0, 6.0)}
    walls = [wall.aabb(IDENTITY) for wall in build_walls(rects, (), heights_m={"low": 2.5, "high": 5.0})]

    def top_at(x: float, y: float) -> float:
        return max(box.high_m[2] for box in walls if box.contains((x, y, 1.0)))

    assert (top_at(0.0, 2.0), top_at(2.0, 0.0)) == (2.5, 2.5)
    assert (top_at(4.0, 2.0), top_at(9.0, 3.0), top_at(4.0, 5.0)) == (5.0, 5.0, 5.0)
    assert all(box.low_m[2] == pytest.approx(0.0) for box in walls), "no wall stands on another"


def test_rooms_keep_their_heights_in_files() -> None:
    scene = build_base_scene("restaurant_hotel")
    assert {room.height_m for room in scene.rooms} > {HOME_M}
    assert scene_from_json(scene_to_json(scene)).rooms == scene.rooms


@pytest.mark.parametrize("scene_id", ["restaurant_hotel", "house_double_floor_lower"])
def test_no_lamp_hangs_at_head_height(scene_id: str) -> None:
    low, lamps = furnishing_counts(build_base_scene(scene_id)).lamps_low
    assert low == 0 < lamps


def test_trees_stand_outdoors_and_lamps_of_gardens_are_left_out() -> None:
    scene = build_base_scene("hotel_gym_spa")
    assert not [item.name for item in scene.objects if item.name.startswith("tree_")]
    assert any("tree-" in note and "outdoors" in note for note in scene.left_out)
