"""Which places lie behind a door that stands open, as the robot stands: an arm does not reach through a leaf."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.geometry.bounds import IDENTITY, joint_motion, parts_of
from embomatrix.world.asset import JointKind

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from embomatrix.sim.geometry.batch_poses import Lineup
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Aabb, FloatArray, Pose
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
    doors = list(_open_doors(asset, pose, fractions))
    if not doors:
        return np.zeros(len(middles), dtype=np.bool_)
    behind = _barred(middles, stand, pose, parts_of(asset).base_boxes(IDENTITY), 0.0)
    for frame, box in doors:
        behind |= _barred(middles, stand, frame, [box], ARM_M)
    return behind


def _open_doors(asset: Asset, pose: Pose, fractions: Sequence[float]) -> Iterator[tuple[Pose, Aabb]]:
    """Frames of the doors that are not shut, and the box of each in its frame."""
    boxes = iter(parts_of(asset).leaves(IDENTITY, (0.0,) * len(fractions)))
    moving = [link for link in asset.links if link.joint is not None]
    for link, fraction in zip(moving, fractions, strict=True):
        joint = link.joint
        if joint is None or not link.parts:
            continue
        box = next(boxes)
        if fraction and joint.kind is JointKind.REVOLUTE and abs(joint.axis[2]) > UPRIGHT:
            yield pose @ joint_motion(joint, fraction), box


def _barred(
    middles: FloatArray, stand: StandPose, frame: Pose, boxes: Sequence[Aabb], margin_m: float
) -> BoolArray:
    """Whether any of k boxes of a frame lies between a place and points of the world, shape (n, 3), in the plan; shape (n,).

    The boxes are grown by the margin in the plane.
    """
    back = frame.inverse()
    turn, offset = back.rotation, np.array(back.position_m)
    points = middles @ turn.T + offset
    base = turn @ np.array((stand.x_m, stand.y_m, frame.position_m[2])) + offset
    lows = np.array([box.low_m for box in boxes]).reshape(-1, 1, 3)
    highs = np.array([box.high_m for box in boxes]).reshape(-1, 1, 3)
    level = (points[:, 2] > lows[..., 2]) & (points[:, 2] < highs[..., 2])  # (k, n)
    crossed = _crossed(base[:2], points[:, :2], lows[..., :2] - margin_m, highs[..., :2] + margin_m)
    return np.asarray((level & crossed).any(axis=0))


def _crossed(base: FloatArray, points: FloatArray, lows: FloatArray, highs: FloatArray) -> BoolArray:
    """Whether the segments from a point, (2,), to others, (n, 2), pass right through rectangles: slab test, shape (k, n).

    ``lows`` and ``highs`` are the rectangles' corners, shape (k, 1, 2).
    """
    way = points - base
    way = np.where(np.abs(way) > 1e-12, way, 1e-12)
    one, other = (lows - base) / way, (highs - base) / way  # (k, n, 2)
    enter = np.minimum(one, other).max(axis=2)
    leave = np.maximum(one, other).min(axis=2)
    return np.asarray((enter < leave) & (leave > 0.0) & (leave < 1.0))
