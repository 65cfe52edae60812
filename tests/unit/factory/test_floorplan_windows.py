from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from embomatrix.factory.floorplan.layout import FloorPlan, plan_floor
from embomatrix.factory.floorplan.spec import OpeningSpec, RoomSpec
from embomatrix.factory.floorplan.walls import PANE_M
from embomatrix.factory.floorplan.windows import GAP_M, HEAD_M, LEAST_SILL_M, sill_and_head
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.scene import ROOM_HEIGHT_M

if TYPE_CHECKING:
    from embomatrix.world.scene import Window

ORIGIN = Pose((0.0, 0.0, 0.0))
CASEMENT = OpeningSpec("casement", 0.8, 0.92)


def house(*windows: OpeningSpec, seed: int = 0) -> FloorPlan:
    """Return a living room with these windows and a bathroom beside it."""
    rooms = [
        RoomSpec("living_room_0", "living_room", (4.0, 5.0), (OpeningSpec("front", 0.9, 2.0),), windows),
        RoomSpec("bathroom_0", "bathroom", (2.0, 2.0)),
    ]
    return plan_floor(rooms, np.random.default_rng(seed), trials=6)


def boxes(plan: FloorPlan) -> list[Aabb]:
    return [wall.aabb(ORIGIN) for wall in plan.walls]


def ends(window: Window) -> tuple[float, float]:
    """Return the window's interval on the axis of its wall."""
    middle = window.center_m[0 if window.along == "x" else 1]
    return middle - window.width_m / 2, middle + window.width_m / 2


def test_window_is_a_pane_between_sill_and_lintel() -> None:
    plan = house(CASEMENT)
    (window,) = plan.windows
    x, y = window.center_m
    assert window.rooms == ("living_room_0", "")
    for height in (window.sill_m - 0.05, window.head_m + 0.05):
        (wall,) = [box for box in boxes(plan) if box.contains((x, y, height))]
        assert min(wall.size_m[:2]) > PANE_M
    (pane,) = [box for box in boxes(plan) if box.contains((x, y, 1.3))]
    assert min(pane.size_m[:2]) == pytest.approx(PANE_M)


@pytest.mark.parametrize(
    ("height", "sill", "head"), [(0.92, 0.9, 1.82), (0.44, 1.71, 2.15), (4.0, 0.1, 2.15)]
)
def test_sill_and_head_follow_the_window_height(height: float, sill: float, head: float) -> None:
    assert sill_and_head(height) == pytest.approx((sill, head))


@given(st.floats(0.05, 20.0))
def test_every_window_fits_the_wall(height: float) -> None:
    sill, head = sill_and_head(height)
    assert LEAST_SILL_M <= sill < head <= HEAD_M < ROOM_HEIGHT_M
    assert head - sill <= height + 1e-9


def test_window_wider_than_its_wall_is_narrowed() -> None:
    (window,) = house(OpeningSpec("front", 30.0, 2.0)).windows
    assert 3.0 < window.width_m < 5.0


def test_windows_without_a_wall_are_reported() -> None:
    plan = house(*[OpeningSpec("bay", 3.0, 1.5)] * 40)
    assert 0 < len(plan.windows) < 40
    reasons = [sentence for sentence in plan.left_out if "window-bay" in sentence]
    assert reasons == [f"{40 - len(plan.windows)} window-bay in living_room_0: no outer wall has room for it"]


def test_windows_may_face_a_garden() -> None:
    rooms = [
        RoomSpec("living_room_0", "living_room", (3.0, 3.0), (), (CASEMENT,) * 3),
        RoomSpec("garden_0", "garden", (30.0, 30.0), (), (CASEMENT,) * 3),
    ]
    plan = plan_floor(rooms, np.random.default_rng(0), trials=4)
    assert len(plan.windows) == 3
    assert all(window.rooms[0] == "living_room_0" for window in plan.windows)
    assert any("3 windows in garden_0" in sentence for sentence in plan.left_out)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(0.3, 9.0), st.floats(0.3, 5.0)), max_size=12), st.integers(0, 2**32 - 1))
def test_no_window_meets_a_doorway_or_another_window(sizes: list[tuple[float, float]], seed: int) -> None:
    plan = house(*(OpeningSpec(f"w{i}", *size) for i, size in enumerate(sizes)), seed=seed)
    taken = [(w.along, w.center_m[w.along == "x"], *ends(w)) for w in plan.windows]
    for door in plan.doorways:
        middle, half = door.center_m[door.along == "y"], door.width_m / 2
        taken.append((door.along, door.center_m[door.along == "x"], middle - half, middle + half))
    for i, (along, at, low, high) in enumerate(taken):
        for other_along, other_at, other_low, other_high in taken[:i]:
            if along == other_along and abs(at - other_at) < 1e-6:
                assert max(low, other_low) >= min(high, other_high) + GAP_M / 2 - 1e-6
