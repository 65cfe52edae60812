"""The arm reaches neither through an open door nor through the wall behind its hinge."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.furniture import cupboard

from embomatrix.sim.geometry.batch_poses import PoseBoxes
from embomatrix.sim.geometry.behind_panels import barriers, behind_panels
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import StandPose

FRIDGE = cupboard("fridge", "electric_refrigerator.n.01", (0.7, 0.7, 1.6), abilities={})
"""It looks along x; its door, hinged at its left, stands along x at y = 0.33 when it is open."""
AHEAD = (1.0, 0.0)
LEFT = (0.6, 0.9)
FAR_LEFT = (0.2, 0.9)
COORDINATE = st.floats(-2.0, 2.0)


def is_behind(
    stand: tuple[float, float], point: tuple[float, float, float], fraction: float, pose: Pose
) -> bool:
    middle = np.array([pose.apply(point)])
    x, y, _ = pose.apply((*stand, 0.0))
    boxes = PoseBoxes(middle - 0.03, middle + 0.03)
    (answer,) = behind_panels(boxes, barriers(FRIDGE, pose, (fraction,)), StandPose(x, y, 0.0)).tolist()
    return bool(answer)


@pytest.mark.parametrize(
    ("stand", "point", "fraction", "behind"),
    [
        (AHEAD, (0.0, 0.1, 0.0), 1.0, False),
        (LEFT, (0.1, 0.0, 0.0), 1.0, True),
        (FAR_LEFT, (0.1, 0.1, 0.0), 1.0, True),
        (LEFT, (0.1, 0.0, 0.0), 0.0, False),
        (LEFT, (0.1, 0.0, 0.9), 1.0, False),
    ],
    ids=["from the front", "through the panel", "through the wall", "a shut door", "over the panel"],
)
def test_only_places_past_an_open_panel_or_its_wall_are_behind(stand, point, fraction, behind) -> None:
    assert is_behind(stand, point, fraction, Pose((0.0, 0.0, 0.8))) is behind


@given(COORDINATE, COORDINATE, st.floats(-math.pi, math.pi), st.sampled_from((AHEAD, LEFT, FAR_LEFT)))
def test_result_does_not_depend_on_the_object_pose(x, y, yaw, stand) -> None:
    point = (0.1, 0.05, 0.0)
    moved = Pose.from_xyz_yaw(x, y, 0.8, yaw)
    assert is_behind(stand, point, 1.0, moved) is is_behind(stand, point, 1.0, Pose((0.0, 0.0, 0.8)))
