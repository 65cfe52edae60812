"""Batch tests of many poses of one object: reach and free space around them, with whole arrays.

The tests use boxes and are cheap and coarse. Exact collision tests follow, one pose at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.caches import BoundedCache
from embomatrix.sim.geometry.bounds import AssetBounds, IntArray, Turned
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import IDENTITY, Aabb, FloatArray, Pose
from embomatrix.world.poses import StandPose

BoolArray = NDArray[np.bool_]

TAKEN_SHARE: Final = 0.16
"""If boxes of two upright cylinders overlap by this share of their extents along both axes, the cylinders overlap."""
HANDY_M: Final = 0.75
HANDY_HEIGHTS_M: Final = (0.35, 1.5)
"""Distance from the base's centre and heights of a place that is easy to reach."""
REACHED: Final = (ROBOT.reach_m, ROBOT.reach_low_m, ROBOT.reach_high_m)
HANDY: Final = (HANDY_M, *HANDY_HEIGHTS_M)
"""Largest distance in the plane, lowest and greatest height of the middle: of a box in reach, and of one easy to reach."""
ROUNDING_M2: Final = 1e-9
"""Squared distances this near to a limit are compared as whole arrays do it, to the last bit."""
SAME_LEVEL_M: Final = 0.02
ROTATIONS_KEPT: Final = 8
"""Rotations of the support for which a set of poses keeps the extents of the object."""


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Boxes of k objects, shape (k, 3) each corner.

    ``one_part`` marks single convex parts, ``movable`` objects that are not fixed; shape (k,).
    """

    lows_m: FloatArray
    highs_m: FloatArray
    one_part: BoolArray
    movable: BoolArray

    @staticmethod
    def of(boxes: Sequence[Aabb], one_part: Sequence[bool], movable: Sequence[bool]) -> Neighbours:
        lows = np.array([box.low_m for box in boxes])
        highs = np.array([box.high_m for box in boxes])
        return Neighbours(lows, highs, np.array(one_part, dtype=np.bool_), np.array(movable, dtype=np.bool_))


@dataclass(frozen=True, slots=True)
class PoseBoxes:
    """World boxes of one object at n poses, shape (n, 3) each corner. Invalid poses are at infinity."""

    lows_m: FloatArray
    highs_m: FloatArray

    def around(self) -> Aabb:
        """Smallest box around all of them; there must be one."""
        (a, b, c), (d, e, f) = self.lows_m.min(axis=0).tolist(), self.highs_m.max(axis=0).tolist()
        return Aabb((a, b, c), (d, e, f))

    def finite(self) -> PoseBoxes:
        """Boxes of the valid poses."""
        valid = np.isfinite(self.lows_m[:, 0])
        return self if valid.all() else PoseBoxes(self.lows_m[valid], self.highs_m[valid])

    def meet(self, others: Sequence[Aabb], margin_m: float) -> BoolArray:
        """Tell for each box, shape (n,), if it overlaps any other one within a margin."""
        if not others:
            return np.zeros(len(self.lows_m), dtype=np.bool_)
        lows, highs = (np.array([box.low_m for box in others]), np.array([box.high_m for box in others]))
        near = (self.lows_m[:, None] - margin_m <= highs) & (
            lows <= self.highs_m[:, None] + margin_m
        )  # (n, k, 3)
        return np.asarray((near[..., 0] & near[..., 1] & near[..., 2]).any(axis=1))

    def each(self) -> Iterator[Aabb]:
        """Yield them one by one."""
        for (a, b, c), (d, e, f) in zip(self.lows_m.tolist(), self.highs_m.tolist(), strict=True):
            yield Aabb((a, b, c), (d, e, f))

    def corners(self) -> list[list[float]]:
        """Return the low and then the high corner of each, six floats."""
        found: list[list[float]] = np.concatenate([self.lows_m, self.highs_m], axis=1).tolist()
        return found

    def at(self, rows: Sequence[int]) -> PoseBoxes:
        """Some of the poses, in the order of ``rows``."""
        return PoseBoxes(self.lows_m[rows], self.highs_m[rows])

    def raised_over(self, height_m: float) -> PoseBoxes:
        """Boxes lifted over a height, as on their way over a rim."""
        rise = np.zeros_like(self.lows_m)
        rise[:, 2] = np.maximum(height_m - self.lows_m[:, 2], 0.0)
        return PoseBoxes(self.lows_m + rise, self.highs_m + rise)

    def reached_from(self, stand: StandPose) -> BoolArray:
        """Tell for each box, shape (n,), if the arm reaches its nearest point in the plane and the height of its middle."""
        return self._within(stand, *REACHED)

    def _within(self, stand: StandPose, away_m: float, low_m: float, high_m: float) -> BoolArray:
        base = np.array((stand.x_m, stand.y_m))
        away = np.maximum(self.lows_m[:, :2] - base, base - self.highs_m[:, :2])  # (n, 2)
        np.maximum(away, 0.0, out=away)
        reached = np.hypot(away[:, 0], away[:, 1]) <= away_m
        # The sum of lowest and highest is twice the height of the middle.
        sums = self.lows_m[:, 2] + self.highs_m[:, 2]
        reached &= sums >= 2 * low_m
        reached &= sums <= 2 * high_m
        return np.asarray(reached)

    def overlaps(self, others: Neighbours) -> tuple[BoolArray, IntArray]:
        """Tell for each pose if the object certainly meets a neighbour, and give the neighbour with the largest shared box.

        Certain means: the boxes overlap by much, and the other is one convex body, or a movable object on the same level. Both
        answers have shape (n,).
        """
        lows, highs = self.lows_m[:, None], self.highs_m[:, None]
        shared = np.minimum(highs, others.highs_m) - np.maximum(lows, others.lows_m)  # (n, k, 3)
        least = TAKEN_SHARE * (highs - lows + (others.highs_m - others.lows_m))
        least[:, :, 2] = SAME_LEVEL_M
        level = np.abs(lows[:, :, 2] - others.lows_m[:, 2]) <= SAME_LEVEL_M
        meets = (shared > least).all(axis=2) & (others.one_part | (others.movable & level))
        most = np.maximum(shared, 0.0).prod(axis=2).argmax(axis=1)
        return np.asarray(meets.any(axis=1)), np.asarray(most)


@dataclass(frozen=True, slots=True)
class Range:
    """Boxes that the arm reaches from one place, tested one by one: equal to the tests of ``PoseBoxes``."""

    x_m: float
    y_m: float
    away_m: float
    least_m: float
    most_m: float
    """Twice the lowest and the greatest height."""

    @staticmethod
    def of(stand: StandPose, away_m: float, low_m: float, high_m: float) -> Range:
        return Range(stand.x_m, stand.y_m, away_m, 2 * low_m, 2 * high_m)

    def includes(self, corners_m: Sequence[float]) -> bool:
        """Return True if a box, low corner and then high corner, is in range."""
        a, b, c, d, e, f = corners_m
        if not self.least_m <= c + f <= self.most_m:
            return False
        x, y, away_m = self.x_m, self.y_m, self.away_m
        dx, dy = max(a - x, x - d, 0.0), max(b - y, y - e, 0.0)
        excess_m2 = dx * dx + dy * dy - away_m * away_m
        if abs(excess_m2) < ROUNDING_M2:
            return bool(np.hypot(dx, dy) <= away_m)
        return excess_m2 < 0.0


@dataclass(frozen=True, slots=True)
class PoseSet:
    """Poses of an object in the frames of a support's links, as arrays over n.

    ``positions_m`` has shape (n, 3); ``turn_of`` and ``link_of``, shape (n,), hold indices into k rotations and into
    ``links``. ``extents`` holds the corners, shape (k, 3) each, of the object's boxes at the rotations relative to its origin,
    by the rotation of a link and the object's joints: furniture rarely turns.
    """

    positions_m: FloatArray
    extents: BoundedCache[Turned, tuple[FloatArray, FloatArray]]
    turn_of: IntArray
    links: tuple[str, ...]
    link_of: IntArray

    @staticmethod
    def of(bounds: AssetBounds, rows: FloatArray, links: Sequence[str], then: Pose = IDENTITY) -> PoseSet:
        """Poses of an object with these bounds on ``links``, one link each.

        ``rows``, shape (n, 7), are positions and quaternions; ``then`` is the object's pose in each of their frames.
        """
        positions, rotations = np.ascontiguousarray(rows[:, :3]), _rotations(rows[:, 3:])
        if then is not IDENTITY:
            positions = positions + rotations @ np.array(then.position_m)
            rotations = rotations @ then.rotation
        names = tuple(dict.fromkeys(links))
        link_of = np.array([names.index(link) for link in links], dtype=np.int64)

        def extents(turned: Turned) -> tuple[FloatArray, FloatArray]:
            quat_xyzw, fractions = turned
            return bounds.extents(Pose(IDENTITY.position_m, quat_xyzw).rotation @ rotations, fractions)

        extents_of = BoundedCache(ROTATIONS_KEPT, extents)
        return PoseSet(positions, extents_of, np.arange(len(rows)), names, link_of)

    def repeated_at(self, positions_m: FloatArray) -> PoseSet:
        """Poses repeated in turn at other positions on their links, shape (m, 3)."""
        rows = np.arange(len(positions_m)) % max(len(self.link_of), 1)
        return PoseSet(positions_m, self.extents, self.turn_of[rows], self.links, self.link_of[rows])

    def world_boxes(self, fractions: tuple[float, ...], frames: Mapping[str, Pose]) -> PoseBoxes:
        """World boxes of the object with these joint positions; at infinity on links without a frame."""
        if len(self.links) == 1 and self.links[0] in frames:
            return PoseBoxes(*self._corners(fractions, frames[self.links[0]], np.s_[:]))
        lows, highs = np.full_like(self.positions_m, np.inf), np.full_like(self.positions_m, np.inf)
        for number, link in enumerate(self.links):
            if link in frames:
                rows = self.link_of == number
                lows[rows], highs[rows] = self._corners(fractions, frames[link], rows)
        return PoseBoxes(lows, highs)

    def _corners(
        self, fractions: tuple[float, ...], frame: Pose, rows: slice | BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Corners of the boxes at some of the poses, shape (m, 3) each, with their link at ``frame``."""
        below, above = self.extents[frame.quat_xyzw, fractions]
        origins = self.positions_m[rows] @ frame.rotation.T + frame.position_m
        turns = self.turn_of[rows]
        return origins + below[turns], origins + above[turns]


def _rotations(quats_xyzw: FloatArray) -> FloatArray:
    """Rotation matrices, shape (n, 3, 3), of unit quaternions, shape (n, 4)."""
    x, y, z, w = quats_xyzw.T
    xx, yy, zz = 2 * x * x, 2 * y * y, 2 * z * z
    xy, xz, yz = 2 * x * y, 2 * x * z, 2 * y * z
    wx, wy, wz = 2 * w * x, 2 * w * y, 2 * w * z
    rows = [[1 - yy - zz, xy - wz, xz + wy], [xy + wz, 1 - xx - zz, yz - wx], [xz - wy, yz + wx, 1 - xx - yy]]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))
