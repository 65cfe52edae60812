"""Which places lie behind a door that stands open, as the robot stands: an arm does not reach through a leaf."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.bounds import IDENTITY, joint_motion
from embomatrix.world.asset import JointKind
from embomatrix.world.geometry import Aabb

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from embomatrix.sim.lineup import Lineup
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import FloatArray, Pose
    from embomatrix.world.poses import StandPose

    BoolArray = NDArray[np.bool_]

ARM_M: Final = 0.05
"""Half the width of what reaches past a leaf."""
UPRIGHT: Final = 0.9
"""Cosine with the vertical from which a hinge is one of a door; what hangs on others, as an oven's, is reached over."""


def behind_leaves(
    boxes: Lineup, asset: Asset, pose: Pose, fractions: Sequence[float], stand: StandPose
) -> BoolArray:
    """Whether an open door of a thing lies between a standing pose and the middle of each box, shape (n,), in the plan.

    Or a wall of it, as who stands behind an open door would else seem to reach in past the hinge. ``pose`` and ``fractions``
    are where the thing stands and how far its joints are open. What is wholly above or below a leaf is not behind it.
    """
    middles = (boxes.lows_m + boxes.highs_m) / 2
    behind = np.zeros(len(middles), dtype=np.bool_)
    doors = list(_open_doors(asset, pose, fractions))
    if not doors:
        return behind
    walls = [(pose, part.aabb(IDENTITY), 0.0) for part in asset.links[0].parts]
    for frame, box, margin_m in (*doors, *walls):
        back = frame.inverse()
        turn, offset = back.rotation, np.array(back.position_m)
        points = middles @ turn.T + offset
        base = turn @ np.array((stand.x_m, stand.y_m, frame.position_m[2])) + offset
        level = (points[:, 2] > box.low_m[2]) & (points[:, 2] < box.high_m[2])
        behind |= level & _crossed(base[:2], points[:, :2], box, margin_m)
    return behind


def _open_doors(asset: Asset, pose: Pose, fractions: Sequence[float]) -> Iterator[tuple[Pose, Aabb, float]]:
    """Frames of the doors that are not shut, the box of each in its frame, and how far the arm keeps from it."""
    moving = [link for link in asset.links if link.joint is not None]
    for link, fraction in zip(moving, fractions, strict=True):
        joint = link.joint
        if joint is None or not fraction or joint.kind is not JointKind.REVOLUTE:
            continue
        if abs(joint.axis[2]) > UPRIGHT and link.parts:
            box = Aabb.around(part.aabb(IDENTITY) for part in link.parts)
            yield pose @ joint_motion(joint, fraction), box, ARM_M


def _crossed(base: FloatArray, points: FloatArray, box: Aabb, margin_m: float) -> BoolArray:
    """Whether the segments from a point, (2,), to others, (n, 2), pass right through a grown box: slab test, shape (n,)."""
    low, high = np.array(box.low_m[:2]) - margin_m, np.array(box.high_m[:2]) + margin_m
    way = points - base
    way = np.where(np.abs(way) > 1e-12, way, 1e-12)
    one, other = (low - base) / way, (high - base) / way
    enter = np.minimum(one, other).max(axis=1)
    leave = np.maximum(one, other).min(axis=1)
    return np.asarray((enter < leave) & (leave > 0.0) & (leave < 1.0))
