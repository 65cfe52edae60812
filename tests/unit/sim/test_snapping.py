"""Stored poses lie on a grid, next to the settled ones and never below them."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.sim.placing.snapping import ACROSS_M, TURN_RAD, UP_M, snapped
from embomatrix.world.geometry import Pose

METRES = st.floats(-20.0, 20.0)
pytestmark = pytest.mark.hypothesis


@given(METRES, METRES, METRES, st.floats(-math.pi, math.pi))
def test_places_move_by_less_than_a_step_and_never_down(x: float, y: float, z: float, yaw: float) -> None:
    pose = Pose.from_xyz_yaw(x, y, z, yaw)
    found = snapped(pose)
    moved = [after - before for after, before in zip(found.position_m, pose.position_m, strict=True)]
    assert max(abs(moved[0]), abs(moved[1])) <= ACROSS_M / 2
    assert 0 <= moved[2] <= UP_M
    assert abs(math.remainder(found.yaw - yaw, math.tau)) <= TURN_RAD
    assert snapped(found) == found


@given(st.integers(-4, 4), st.floats(-TURN_RAD, TURN_RAD), st.floats(-9e-4, 9e-4))
def test_nearly_upright_poses_at_quarter_turns_become_exact(quarters: int, off: float, tilt: float) -> None:
    yaw = quarters * math.pi / 2 + off * 0.99
    turned = Pose.from_xyz_yaw(0.0, 0.0, 0.0, yaw) @ Pose(
        (0.0, 0.0, 0.0), (math.sin(tilt / 2), 0.0, 0.0, math.cos(tilt / 2))
    )
    found = snapped(turned)
    assert found.quat_xyzw[:2] == (0.0, 0.0)
    assert math.remainder(found.yaw, math.pi / 2) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("yaw", [0.3, 1.2])
def test_other_rotations_stay(yaw: float) -> None:
    pose = Pose.from_xyz_yaw(0.1, 0.2, 0.3, yaw)
    assert snapped(pose).quat_xyzw == pose.quat_xyzw
    leaning = Pose((0.0, 0.0, 0.0), (math.sin(0.1), 0.0, 0.0, math.cos(0.1)))
    assert snapped(leaning).quat_xyzw == leaning.quat_xyzw
