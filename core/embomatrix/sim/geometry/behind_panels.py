"""Regions behind open doors: the arm does not reach through a door panel."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.geometry.batch_poses import PoseBoxes
from embomatrix.sim.geometry.bounds import bounds_of, joint_motion
from embomatrix.world.asset import Asset, JointKind
from embomatrix.world.geometry import IDENTITY, Aabb, FloatArray, Pose
from embomatrix.world.poses import StandPose

BoolArray = NDArray[np.bool_]

ARM_M: Final = 0.05
"""Half the width of the arm beside a door panel."""
UPRIGHT: Final = 0.9
"""Smallest cosine between a door's hinge and the vertical; the arm reaches over other panels, such as an oven's."""


def behind_panels(
    boxes: PoseBoxes, asset: Asset, pose: Pose, fractions: Sequence[float], stand: StandPose
) -> BoolArray:
    """Return for each box, shape (n,), True if an open door separates its middle from a standing pose in the plan.

    Walls of the object count too: otherwise a robot behind an open door would seem to reach in past the hinge. ``pose`` and
    ``fractions`` are the object's pose and joint positions. A box wholly above or below a panel is not behind it.
    """
    middles = (boxes.lows_m + boxes.highs_m) / 2
    doors = list(_open_doors(asset, pose, fractions))
    if not doors:
        return np.zeros(len(middles), dtype=np.bool_)
    behind = _blocked(middles, stand, pose, bounds_of(asset).base_boxes(IDENTITY), 0.0)
    for frame, box in doors:
        behind |= _blocked(middles, stand, frame, [box], ARM_M)
    return behind


def reaches_in(centers: FloatArray, asset: Asset, pose: Pose, fractions: Sequence[float]) -> BoolArray:
    """Return for each point of the floor, shape (n, 2), True if the arm reaches from there into a cavity with an open door.

    True everywhere for an object without an open door.
    """
    doors = list(_open_doors(asset, pose, fractions))
    middles = [pose.apply(interior.center_m) for interior in asset.interiors if not interior.link]
    if not doors or not middles:
        return np.ones(len(centers), dtype=np.bool_)
    walls = bounds_of(asset).base_boxes(IDENTITY)
    reached = np.zeros(len(centers), dtype=np.bool_)
    for x, y, z in middles:
        middle = StandPose(x, y, 0.0)
        points = np.column_stack([centers, np.full(len(centers), z)])  # (n, 3)
        barred = _blocked(points, middle, pose, walls, 0.0)
        for frame, box in doors:
            barred |= _blocked(points, middle, frame, [box], ARM_M)
        reached |= ~barred
    return reached


def _open_doors(asset: Asset, pose: Pose, fractions: Sequence[float]) -> Iterator[tuple[Pose, Aabb]]:
    """Frames of the open doors, each with the door's box in its frame."""
    boxes = iter(bounds_of(asset).panel_boxes(IDENTITY, (0.0,) * len(fractions)))
    moving = [link for link in asset.links if link.joint is not None]
    for link, fraction in zip(moving, fractions, strict=True):
        joint = link.joint
        if joint is None or not link.parts:
            continue
        box = next(boxes)
        if fraction and joint.kind is JointKind.REVOLUTE and abs(joint.axis[2]) > UPRIGHT:
            yield pose @ joint_motion(joint, fraction), box


def _blocked(
    middles: FloatArray, stand: StandPose, frame: Pose, boxes: Sequence[Aabb], margin_m: float
) -> BoolArray:
    """Return for each world point, shape (n, 3), True if any of k boxes separates it from ``stand`` in the plan.

    The boxes are given in ``frame`` and grown by the margin in the plane. Boxes above or below a point do not separate it.
    """
    back = frame.inverse()
    turn, offset = back.rotation, np.array(back.position_m)
    points = middles @ turn.T + offset
    base = turn @ np.array((stand.x_m, stand.y_m, frame.position_m[2])) + offset
    lows = np.array([box.low_m for box in boxes]).reshape(-1, 1, 3)
    highs = np.array([box.high_m for box in boxes]).reshape(-1, 1, 3)
    level = (points[:, 2] > lows[..., 2]) & (points[:, 2] < highs[..., 2])  # (k, n)
    # Most boxes are above or below all points, and the slab test takes ten times as long as this one.
    chosen = level.any(axis=1)
    lows, highs = lows[chosen, :, :2] - margin_m, highs[chosen, :, :2] + margin_m
    return np.asarray((level[chosen] & _crossed(base[:2], points[:, :2], lows, highs)).any(axis=0))


def _crossed(base: FloatArray, points: FloatArray, lows: FloatArray, highs: FloatArray) -> BoolArray:
    """Slab test, shape (k, n), of segments from a point, (2,), to others, (n, 2), against rectangles.

    ``lows`` and ``highs`` are the rectangles' corners, shape (k, 1, 2).
    """
    way = points - base
    way = np.where(np.abs(way) > 1e-12, way, 1e-12)
    one, other = (lows - base) / way, (highs - base) / way  # (k, n, 2)
    first, last = np.minimum(one, other), np.maximum(one, other)
    # Two columns: comparing them takes a tenth of a reduction along the short axis.
    enter = np.maximum(first[..., 0], first[..., 1])
    leave = np.minimum(last[..., 0], last[..., 1])
    return np.asarray((enter < leave) & (leave > 0.0) & (leave < 1.0))
