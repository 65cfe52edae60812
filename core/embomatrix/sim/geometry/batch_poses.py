"""Many poses of one thing at once: which of them are in reach, and which have room around them, as whole arrays.

Boxes decide, so the answers are cheap and coarse. What is really free is looked at later, one pose at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.geometry.bounds import IDENTITY, quarter_turns
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Aabb

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from embomatrix.sim.geometry.bounds import AssetBounds, IntArray
    from embomatrix.world.geometry import FloatArray, Pose
    from embomatrix.world.poses import StandPose

    BoolArray = NDArray[np.bool_]

TAKEN_SHARE: Final = 0.16
"""Boxes of two upright cylinders that overlap by this share of their extents along both axes are of cylinders that do."""
HANDY_M: Final = 0.75
HANDY_HEIGHTS_M: Final = (0.35, 1.5)
"""So near to the base's centre, and with its middle between these heights, a place is reached with ease."""
SAME_LEVEL_M: Final = 0.02


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Boxes of k objects, shape (k, 3) each corner.

    ``one_part`` tells which are a single convex part, ``movable`` which are not fixed; shape (k,).
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
    """Boxes in the world that one thing has at n poses, shape (n, 3) each corner. A pose that is none is at infinity."""

    lows_m: FloatArray
    highs_m: FloatArray

    def around(self) -> Aabb:
        """Smallest box that holds all of them; there must be one."""
        (a, b, c), (d, e, f) = self.lows_m.min(axis=0).tolist(), self.highs_m.max(axis=0).tolist()
        return Aabb((a, b, c), (d, e, f))

    def crowded(self, others: Sequence[Aabb], margin_m: float) -> Iterator[bool]:
        """Whether each box, grown by a margin, overlaps any of some others, one by one: most askers take the first few."""
        for (a, b, c), (d, e, f) in zip(self.lows_m.tolist(), self.highs_m.tolist(), strict=True):
            box = Aabb((a, b, c), (d, e, f)).grown(margin_m)
            yield any(box.overlaps(other) for other in others)

    def at(self, rows: Sequence[int]) -> PoseBoxes:
        """Some of the poses, in the order of ``rows``."""
        return PoseBoxes(self.lows_m[rows], self.highs_m[rows])

    def raised_over(self, height_m: float) -> PoseBoxes:
        """The boxes as high up as they must come on their way, those that begin lower over a height."""
        rise = np.zeros_like(self.lows_m)
        rise[:, 2] = np.maximum(height_m - self.lows_m[:, 2], 0.0)
        return PoseBoxes(self.lows_m + rise, self.highs_m + rise)

    def reached_from(self, stand: StandPose) -> BoolArray:
        """Whether the arm reaches the nearest point of each box in the plane, and its middle's height; shape (n,)."""
        return self._within(stand, ROBOT.reach_m, ROBOT.reach_low_m, ROBOT.reach_high_m)

    def handy_from(self, stand: StandPose) -> BoolArray:
        """Whether the arm gets at each box with ease: neither far out nor near the floor or overhead; shape (n,)."""
        return self._within(stand, HANDY_M, *HANDY_HEIGHTS_M)

    def _within(self, stand: StandPose, away_m: float, low_m: float, high_m: float) -> BoolArray:
        base = np.array((stand.x_m, stand.y_m))
        away = np.maximum(self.lows_m[:, :2] - base, base - self.highs_m[:, :2])  # (n, 2)
        np.maximum(away, 0.0, out=away)
        reached = np.hypot(away[:, 0], away[:, 1]) <= away_m
        # Of lowest and highest: twice the height of the middle.
        sums = self.lows_m[:, 2] + self.highs_m[:, 2]
        reached &= sums >= 2 * low_m
        reached &= sums <= 2 * high_m
        return np.asarray(reached)

    def overlaps(self, others: Neighbours) -> tuple[BoolArray, IntArray]:
        """Whether the thing would surely meet a neighbour at each pose, and the one whose box it shares the most with.

        Surely is: the boxes overlap by much, and the other is one convex body, or a vessel or the like that stands on the
        same level. Both answers have the shape (n,).
        """
        lows, highs = self.lows_m[:, None], self.highs_m[:, None]
        shared = np.minimum(highs, others.highs_m) - np.maximum(lows, others.lows_m)  # (n, k, 3)
        least = TAKEN_SHARE * (highs - lows + (others.highs_m - others.lows_m))
        least[:, :, 2] = SAME_LEVEL_M
        level = np.abs(lows[:, :, 2] - others.lows_m[:, 2]) <= SAME_LEVEL_M
        meets = (shared > least).all(axis=2) & (others.one_part | (others.movable & level))
        most = np.maximum(shared, 0.0).prod(axis=2).argmax(axis=1)
        return np.asarray(meets.any(axis=1)), np.asarray(most)


_COLUMNS: Final = tuple(
    np.array(columns)
    for columns in ((0, 1, 2, 3, 4, 5), (4, 0, 2, 1, 3, 5), (3, 4, 2, 0, 1, 5), (1, 3, 2, 4, 0, 5))
)
"""From which column of a box's corners each one comes after 0 to 3 quarter turns about z."""
_SIGNS: Final = tuple(
    np.array(signs, dtype=np.float64)
    for signs in ((1, 1, 1, 1, 1, 1), (-1, 1, 1, -1, 1, 1), (-1, -1, 1, -1, -1, 1), (1, -1, 1, 1, -1, 1))
)
"""And with which sign."""


@dataclass(frozen=True, slots=True)
class LinkBoxes:
    """Boxes of one thing at n poses, each in the frame of the support's link that it rides on.

    ``corners_m`` has shape (n, 6), the low corner first; ``link_of``, shape (n,), tells where in ``links`` each one rides.
    """

    corners_m: FloatArray
    links: tuple[str, ...]
    link_of: IntArray

    def moved(self, rows: IntArray, by_m: FloatArray) -> LinkBoxes:
        """The boxes of these rows, shape (m,), each moved on its link by its own way, shape (m, 3)."""
        return LinkBoxes(self.corners_m[rows] + np.tile(by_m, 2), self.links, self.link_of[rows])

    def world_boxes(self, frames: Mapping[str, Pose]) -> PoseBoxes | None:
        """The boxes in the world; at infinity on links without a frame, None when a frame is not square to the world."""
        turns = {link: quarter_turns(frames[link]) for link in self.links if link in frames}
        if -1 in turns.values():
            return None
        if len(self.links) == 1 and turns:
            (link,) = self.links
            return _split(_turned(self.corners_m, turns[link], frames[link]))
        placed = np.full_like(self.corners_m, np.inf)
        for number, link in enumerate(self.links):
            if link in turns:
                rows = self.link_of == number
                placed[rows] = _turned(self.corners_m[rows], turns[link], frames[link])
        return _split(placed)


def _turned(corners_m: FloatArray, turns: int, frame: Pose) -> FloatArray:
    """Boxes of a frame, shape (n, 6), in the world, where the frame is turned by so many quarter turns about z."""
    placed = corners_m[:, _COLUMNS[turns]]
    placed *= _SIGNS[turns]
    placed += np.array(frame.position_m * 2)
    return placed


def _split(corners_m: FloatArray) -> PoseBoxes:
    return PoseBoxes(corners_m[:, :3], corners_m[:, 3:])


@dataclass(frozen=True, slots=True)
class PoseSet:
    """n poses of a thing in the frames of a support's links, as arrays.

    ``positions_m`` has shape (n, 3), ``rotations`` (k, 3, 3); ``turn_of``, shape (n,), tells which of these each pose has,
    and ``link_of``, shape (n,), where in ``links`` it rides.
    """

    positions_m: FloatArray
    rotations: FloatArray
    turn_of: IntArray
    links: tuple[str, ...]
    link_of: IntArray

    @staticmethod
    def of(rows: FloatArray, links: Sequence[str], then: Pose = IDENTITY) -> PoseSet:
        """Poses that ride on ``links``, one for each; ``then`` is the thing's pose in each of their frames.

        ``rows``, shape (n, 7), are positions and quaternions.
        """
        positions, rotations = np.ascontiguousarray(rows[:, :3]), _rotations(rows[:, 3:])
        if then is not IDENTITY:
            positions, rotations = (
                positions + rotations @ np.array(then.position_m),
                rotations @ then.rotation,
            )
        names = tuple(dict.fromkeys(links))
        if len(names) > 1:
            link_of = np.array([names.index(link) for link in links], dtype=np.int64)
        else:
            link_of = np.zeros(len(links), dtype=np.int64)
        return PoseSet(positions, rotations, np.arange(len(rows)), names, link_of)

    def repeated_at(self, positions_m: FloatArray) -> PoseSet:
        """The poses in turn, again and again, moved to positions on their links, shape (m, 3)."""
        rows = np.arange(len(positions_m)) % max(len(self.link_of), 1)
        return PoseSet(positions_m, self.rotations, self.turn_of[rows], self.links, self.link_of[rows])

    def boxes(self, bounds: AssetBounds) -> LinkBoxes:
        """Boxes of a thing with these bounds, its joints shut, in the frames of the links."""
        found = self.world_boxes(bounds, (), dict.fromkeys(self.links, IDENTITY))
        return LinkBoxes(np.concatenate([found.lows_m, found.highs_m], axis=1), self.links, self.link_of)

    def world_boxes(
        self, bounds: AssetBounds, fractions: Sequence[float], frames: Mapping[str, Pose]
    ) -> PoseBoxes:
        """Boxes of a thing with these bounds and joint positions, where the links are; at infinity on links without frame."""
        if not self.links:
            return PoseBoxes(np.zeros((0, 3)), np.zeros((0, 3)))
        if len(self.links) == 1 and self.links[0] in frames:
            return PoseBoxes(*self._extents(bounds, fractions, frames[self.links[0]], np.s_[:]))
        lows, highs = np.full_like(self.positions_m, np.inf), np.full_like(self.positions_m, np.inf)
        for number, link in enumerate(self.links):
            if link in frames:
                rows = self.link_of == number
                lows[rows], highs[rows] = self._extents(bounds, fractions, frames[link], rows)
        return PoseBoxes(lows, highs)

    def _extents(
        self, bounds: AssetBounds, fractions: Sequence[float], frame: Pose, rows: slice | BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Corners of the boxes at some of the poses, shape (m, 3) each, where the link that they ride on is at ``frame``."""
        turn = frame.rotation
        below, above = bounds.extents(turn @ self.rotations, fractions)  # (k, 3) each
        origins = self.positions_m[rows] @ turn.T + frame.position_m
        turns = self.turn_of[rows]
        return origins + below[turns], origins + above[turns]


def _rotations(quats_xyzw: FloatArray) -> FloatArray:
    """Rotation matrices, shape (n, 3, 3), of unit quaternions, shape (n, 4)."""
    x, y, z, w = quats_xyzw.T
    xx, yy, zz = 2 * x * x, 2 * y * y, 2 * z * z
    xy, xz, yz = 2 * x * y, 2 * x * z, 2 * y * z
    wx, wy, wz = 2 * w * x, 2 * w * y, 2 * w * z
    found = np.empty((len(x), 3, 3))
    found[:, 0, 0], found[:, 0, 1], found[:, 0, 2] = 1 - yy - zz, xy - wz, xz + wy
    found[:, 1, 0], found[:, 1, 1], found[:, 1, 2] = xy + wz, 1 - xx - zz, yz - wx
    found[:, 2, 0], found[:, 2, 1], found[:, 2, 2] = xz - wy, yz + wx, 1 - xx - yy
    return found
