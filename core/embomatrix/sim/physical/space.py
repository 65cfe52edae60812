"""Free space around the robot: parts of the scene as oriented boxes, and collision checks of balls against them.

The boxes come from the planning scene, to judge a motion before it is made.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.engine import BACKGROUND, FLOOR, WALL, PhysicsEngine
from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, Aabb, FloatArray, Pose, Shape

BoolArray = NDArray[np.bool_]

TOGETHER: Final = 6
"""Neighbouring balls that are first checked as one enclosing ball."""
LEAST_BALL_M: Final = 0.012
"""Least radius of the balls that fill a held object."""
CHUNK: Final = 40_000
"""Pairs of balls and boxes to compare at once, sized for a processor cache."""


@dataclass(frozen=True, slots=True)
class Boxes:
    """Oriented boxes: rotations (m, 3, 3), centres (m, 3), half extents (m, 3), and the name of each owner."""

    rotation: FloatArray
    centre: FloatArray
    half: FloatArray
    owners: tuple[str, ...]

    def without(self, names: Iterable[str]) -> Boxes:
        """Return the boxes without those of some owners."""
        left_out = frozenset(names)
        keep = np.array([owner not in left_out for owner in self.owners], dtype=np.bool_)
        return self.where(keep)

    def only(self, name: str) -> Boxes:
        """Return the boxes of one owner."""
        return self.where(np.array([owner == name for owner in self.owners], dtype=np.bool_))

    def where(self, keep: BoolArray) -> Boxes:
        """Return the boxes that a mask, (m,), keeps."""
        owners = tuple(owner for owner, kept in zip(self.owners, keep, strict=True) if kept)
        return Boxes(self.rotation[keep], self.centre[keep], self.half[keep], owners)

    def joined(self, other: Boxes) -> Boxes:
        """Return these boxes and others."""
        return Boxes(
            np.concatenate([self.rotation, other.rotation]),
            np.concatenate([self.centre, other.centre]),
            np.concatenate([self.half, other.half]),
            (*self.owners, *other.owners),
        )

    def shrunk_clear_of(self, points: FloatArray, radii: FloatArray, margin_m: float) -> Boxes:
        """Shrink boxes that balls, (k, 3) and (k,), come nearer to than a margin, by the missing distance."""
        lack = np.maximum(margin_m - (self.gaps(points) - radii[:, None]).min(axis=0), 0.0)  # (m,)
        return Boxes(self.rotation, self.centre, self.half - lack[:, None], self.owners)

    def near(self, low: FloatArray, high: FloatArray) -> Boxes:
        """Return the boxes whose bounds overlap a box between two corners."""
        reach = np.einsum("mij,mj->mi", np.abs(self.rotation), self.half)
        keep = ((self.centre - reach <= high) & (self.centre + reach >= low)).all(axis=1)
        return self.where(keep)

    def within(self, points: FloatArray, reach_m: FloatArray) -> BoolArray:
        """Mask, (k, m), of points, (k, 3), that are nearer to a box than their positive distance, (k,)."""
        offset = np.einsum("mj,mji->im", self.centre, self.rotation)
        squares = np.zeros((len(points), len(self.owners)))
        for axis in range(3):
            local = points @ self.rotation[:, :, axis].T
            local -= offset[axis]
            np.abs(local, out=local)
            local -= self.half[:, axis]
            np.maximum(local, 0.0, out=local)
            local *= local
            squares += local
        return np.asarray(squares < (reach_m * reach_m)[:, None])

    def gaps(self, points: FloatArray) -> FloatArray:
        """Signed distances of points, (k, 3), to every box, (k, m), negative inside."""
        # One matrix per box axis: numpy is slow at sums over an axis of length three.
        offset = np.einsum("mj,mji->im", self.centre, self.rotation)
        deepest = np.full((len(points), len(self.owners)), -np.inf)
        outside = np.zeros((len(points), len(self.owners)))
        for axis in range(3):
            local = points @ self.rotation[:, :, axis].T
            local -= offset[axis]
            np.abs(local, out=local)
            local -= self.half[:, axis]
            np.maximum(deepest, local, out=deepest)
            np.maximum(local, 0.0, out=local)
            local *= local
            outside += local
        np.sqrt(outside, out=outside)
        outside += np.minimum(deepest, 0.0, out=deepest)
        return outside


@dataclass(frozen=True, slots=True)
class BallCollision:
    """Sets of balls, centres (n, b, 3) and radii (b,), among boxes. ``rows``, (n,), marks sets nearer than a margin."""

    boxes: Boxes
    balls: FloatArray
    radii: FloatArray
    margin_m: float
    rows: BoolArray

    def only(self, row: int) -> BallCollision:
        """Return one of the sets."""
        one = slice(row, row + 1)
        return BallCollision(self.boxes, self.balls[one], self.radii, self.margin_m, self.rows[one])

    @property
    def owner(self) -> str:
        """Owner of the box that the first set is deepest in; "" for none."""
        number = deepest_box(self.boxes, self.balls[0], self.radii, self.margin_m)
        return self.boxes.owners[number] if number >= 0 else ""


def boxes_around(engine: PhysicsEngine, low: tuple[float, float], high: tuple[float, float]) -> Boxes:
    """Return the parts of objects, walls and background over a rectangle of the floor, with doors where they are now."""
    scene = engine.scene
    window = Aabb((low[0], low[1], -1.0), (high[0], high[1], 3.0))
    rows: list[tuple[Pose, tuple[float, float, float], str]] = []
    for name in engine.near(window):
        rows += [
            (pose, size, name)
            for pose, size in part_boxes(scene.asset_of(name), engine.pose(name), engine.joints(name))
        ]
    for wall in scene.walls:
        if wall.aabb(IDENTITY).overlaps(window):
            rows.append((wall.pose, wall.size_m, WALL))
    for part, box in zip(scene.background_parts, scene.background_boxes, strict=True):
        if box.overlaps(window):
            rows.append((part.pose, part.size_m, BACKGROUND))
    rows.append((Pose((0.0, 0.0, -0.5)), (1e3, 1e3, 1.0), FLOOR))
    return boxes_of(rows).near(np.array(window.low_m), np.array(window.high_m))


def part_boxes(
    asset: Asset, pose: Pose, fractions: Sequence[float]
) -> list[tuple[Pose, tuple[float, float, float]]]:
    """Return world pose and size of the box around each part of an asset, with joints at shares of their travel."""
    shares = iter(fractions)
    found = []
    for link in asset.links:
        frame = pose if link.joint is None else pose @ joint_motion(link.joint, next(shares, 0.0))
        for part in link.parts:
            found.append((frame @ part.pose, _size(part.shape, part.size_m)))
    return found


def object_balls(asset: Asset, fractions: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """Return balls that fill the parts of an asset, in its frame: centres (k, 3) and radii (k,). Large flat parts get many."""
    centres, radii = [], []
    for pose, size in part_boxes(asset, IDENTITY, fractions):
        half = np.array(size) / 2
        radius = max(LEAST_BALL_M, float(half.min()))
        spans = [np.linspace(-1, 1, _count(extent, radius)) * max(extent - radius, 0.0) for extent in half]
        grid = np.stack(np.meshgrid(*spans, indexing="ij"), axis=-1).reshape(-1, 3)
        centres.append(pose.apply_all(grid))
        radii.append(np.full(len(grid), radius))
    return np.concatenate(centres), np.concatenate(radii)


def deepest_box(boxes: Boxes, balls: FloatArray, radii: FloatArray, margin_m: float) -> int:
    """Return the index of the box that balls, (b, 3) and (b,), are deepest in within a margin; -1 for none."""
    if not boxes.owners:
        return -1
    nearest = (boxes.gaps(balls) - radii[:, None]).min(axis=0)  # (m,)
    deepest = int(nearest.argmin())
    return deepest if nearest[deepest] < margin_m else -1


def collides(boxes: Boxes, balls: FloatArray, radii: FloatArray, margin_m: float) -> BoolArray:
    """Mask, (n,), of sets of balls, (n, b, 3), that come nearer than a margin to any box.

    radii: (b,), each larger than a negative margin. Neighbouring balls are first checked as one; only near groups are then
    checked ball by ball.
    """
    count, each, _ = balls.shape
    found = np.zeros(count, dtype=np.bool_)
    if not boxes.owners or not count:
        return found
    whole = np.minimum(np.arange(each + -each % TOGETHER), each - 1)
    some, sizes = balls[:, whole].reshape(count, -1, TOGETHER, 3), (radii + margin_m)[whole]
    middle = some.mean(axis=2)  # (n, groups, 3)
    off = some - middle[:, :, None]
    wide = (np.sqrt((off * off).sum(axis=3)) + sizes.reshape(-1, TOGETHER)).max(axis=2)  # (n, groups)
    rows = max(1, CHUNK // (middle.shape[1] * len(boxes.owners)))
    for start in range(0, count, rows):
        part = slice(start, start + rows)
        near = boxes.within(middle[part].reshape(-1, 3), wide[part].ravel())
        group = np.flatnonzero(near.any(axis=1))
        close = boxes.where(np.asarray(near.any(axis=0)))
        points = some[part].reshape(-1, TOGETHER, 3)[group].reshape(-1, 3)
        reach_m = np.tile(sizes, (len(some[part]), 1)).reshape(-1, TOGETHER)[group].ravel()
        hit = close.within(points, reach_m).any(axis=1).reshape(-1, TOGETHER).any(axis=1)
        found[start + group[hit] // middle.shape[1]] = True
    return found


def _count(half_m: float, radius: float) -> int:
    return 1 if half_m <= radius * 1.2 else min(9, int(np.ceil((half_m - radius) / (radius * 1.5))) + 1)


def _size(shape: Shape, size: tuple[float, float, float]) -> tuple[float, float, float]:
    """Shrink the boxes of round parts: the box around a ball has twice its volume."""
    if shape is Shape.CYLINDER:
        return (size[0] * 0.9, size[1] * 0.9, size[2])
    if shape is Shape.SPHERE:
        return (size[0] * 0.85, size[1] * 0.85, size[2] * 0.85)
    return size


def boxes_of(rows: Sequence[tuple[Pose, tuple[float, float, float], str]]) -> Boxes:
    """Return boxes from rows of (pose, size, owner)."""
    return Boxes(
        np.array([pose.rotation for pose, _, _ in rows]).reshape(-1, 3, 3),
        np.array([pose.position_m for pose, _, _ in rows]).reshape(-1, 3),
        np.array([size for _, size, _ in rows]).reshape(-1, 3) / 2,
        tuple(owner for _, _, owner in rows),
    )
