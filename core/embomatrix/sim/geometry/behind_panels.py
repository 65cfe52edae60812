"""Regions behind open doors: the arm does not reach through a door panel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True)
class Barrier:
    """Boxes that the arm does not pass, in a frame with this rotation and offset from the world.

    ``base_m`` is the height of the frame in the world. ``levels_m``, shape (2, k, 1), are the lowest and greatest heights of k
    boxes; ``lows_m`` and ``highs_m``, shape (k, 1, 2), their corners in the plane.
    """

    turn: FloatArray
    offset_m: FloatArray
    base_m: float
    levels_m: FloatArray
    lows_m: FloatArray
    highs_m: FloatArray

    @staticmethod
    def of(frame: Pose, boxes: Sequence[Aabb], margin_m: float) -> Barrier:
        """Barrier of boxes in a frame, grown by the margin in the plane."""
        back = frame.inverse()
        lows = np.array([box.low_m for box in boxes]).reshape(-1, 1, 3)
        highs = np.array([box.high_m for box in boxes]).reshape(-1, 1, 3)
        return Barrier(
            back.rotation,
            np.array(back.position_m),
            frame.position_m[2],
            np.stack([lows[..., 2], highs[..., 2]]),
            lows[..., :2] - margin_m,
            highs[..., :2] + margin_m,
        )

    def separates(self, stand: StandPose, middles: FloatArray) -> BoolArray:
        """Return for each world point, shape (n, 3), True if any box separates it from ``stand`` in the plan.

        Boxes above or below a point do not separate it.
        """
        points = middles @ self.turn.T + self.offset_m
        low, high = self.levels_m
        level = (points[:, 2] > low) & (points[:, 2] < high)  # (k, n)
        # Most boxes are above or below all points, and the slab test takes ten times as long as this one.
        chosen = level.any(axis=1)
        if not chosen.any():
            return np.zeros(len(points), dtype=np.bool_)
        base = self.turn @ np.array((stand.x_m, stand.y_m, self.base_m)) + self.offset_m
        crossed = _crossed(base[:2], points[:, :2], self.lows_m[chosen], self.highs_m[chosen])
        return np.asarray((level[chosen] & crossed).any(axis=0))


def barriers(asset: Asset, pose: Pose, fractions: Sequence[float]) -> tuple[Barrier, ...]:
    """Barriers around the cavities of an object with open doors: its walls, then the doors; empty without an open door.

    Walls count too: otherwise a robot behind an open door would seem to reach in past the hinge. ``pose`` and ``fractions`` are
    the object's pose and joint positions.
    """
    doors = tuple(Barrier.of(frame, [box], ARM_M) for frame, box in _open_doors(asset, pose, fractions))
    return (Barrier.of(pose, bounds_of(asset).base_boxes(IDENTITY), 0.0), *doors) if doors else ()


def behind_panels(boxes: PoseBoxes, around: Sequence[Barrier], stand: StandPose) -> BoolArray:
    """Return for each box, shape (n,), True if a barrier separates its middle from a standing pose in the plan.

    A box wholly above or below a door is not behind it.
    """
    middles = (boxes.lows_m + boxes.highs_m) / 2
    behind = np.zeros(len(middles), dtype=np.bool_)
    for barrier in around:
        behind |= barrier.separates(stand, middles)
    return behind


def reaches_in(centers: FloatArray, asset: Asset, pose: Pose, fractions: Sequence[float]) -> BoolArray:
    """Return for each point of the floor, shape (n, 2), True if the arm reaches from there into a cavity with an open door.

    True everywhere for an object without an open door.
    """
    around = barriers(asset, pose, fractions)
    middles = [pose.apply(interior.center_m) for interior in asset.interiors if not interior.link]
    if not around or not middles:
        return np.ones(len(centers), dtype=np.bool_)
    reached = np.zeros(len(centers), dtype=np.bool_)
    for x, y, z in middles:
        middle = StandPose(x, y, 0.0)
        points = np.column_stack([centers, np.full(len(centers), z)])  # (n, 3)
        barred = np.zeros(len(centers), dtype=np.bool_)
        for barrier in around:
            barred |= barrier.separates(middle, points)
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
