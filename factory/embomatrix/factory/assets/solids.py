"""Collision test of placed assets by separating axes on convex vertex sets, without a physics engine.

Boxes are exact at any yaw; cylinders are prisms of 32 sides. Edge-edge axes are not tested, so the depth reported for tilted
parts may be too large, but never too small.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import ConvexHull

from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, ConvexPart, FloatArray, Pose, Shape
from embomatrix.world.scene import Scene

TOLERANCE_M: Final = 0.001
"""Shallower overlaps are contact, not penetration."""
WALL: Final = "wall"
BACKGROUND: Final = "background"
_SIDES: Final = 32


@dataclass(frozen=True, eq=False)
class Convex:
    """Convex part in the world: vertices (n, 3), unit axes to test (k, 3), and a radius around the vertices (spheres)."""

    vertices: FloatArray
    axes: FloatArray
    radius_m: float = 0.0

    @functools.cached_property
    def low(self) -> FloatArray:
        return np.asarray(self.vertices.min(axis=0) - self.radius_m)

    @functools.cached_property
    def high(self) -> FloatArray:
        return np.asarray(self.vertices.max(axis=0) + self.radius_m)

    @functools.cached_property
    def center(self) -> FloatArray:
        return np.asarray(self.vertices.mean(axis=0))


def convex_of(part: ConvexPart, pose_world_asset: Pose) -> Convex:
    """Return a part of an asset at a pose."""
    local, axes, radius = _template(part.shape, part.size_m, part.vertices_m)
    placed = pose_world_asset @ part.pose
    return Convex(placed.apply_all(local), np.asarray(axes @ placed.rotation.T), radius)


@functools.lru_cache(maxsize=4096)
def _template(
    shape: Shape, size_m: tuple[float, float, float], vertices_m: tuple[tuple[float, float, float], ...]
) -> tuple[FloatArray, FloatArray, float]:
    x, y, z = (extent / 2 for extent in size_m)
    match shape:
        case Shape.BOX:
            corners = np.array([(a * x, b * y, c * z) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
            return corners, np.eye(3), 0.0
        case Shape.SPHERE:
            return np.zeros((1, 3)), np.empty((0, 3)), x
        case Shape.CYLINDER:
            angles = np.arange(_SIDES) * 2 * math.pi / _SIDES
            ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(_SIDES)], axis=1)
            half = np.array([0.0, 0.0, z])
            normals = np.concatenate([ring[: _SIDES // 2], [[0.0, 0.0, 1.0]]])
            return np.concatenate([ring * x - half, ring * x + half]), normals, 0.0
        case Shape.HULL:
            points = np.asarray(vertices_m)
            return points, np.unique(ConvexHull(points).equations[:, :3].round(6), axis=0), 0.0


def depth_m(a: Convex, b: Convex) -> float:
    """Return the overlap of two convex parts along the best tested axis; negative if an axis separates them."""
    ca, cb = a.center, b.center
    between = cb - ca
    lines = (
        between,
        between * (1.0, 1.0, 0.0),
        np.clip(ca, b.low, b.high) - ca,
        np.clip(cb, a.low, a.high) - cb,
    )
    extra = [line / np.linalg.norm(line) for line in lines if np.linalg.norm(line) > 1e-9]
    axes = np.concatenate([a.axes, b.axes, np.asarray(extra).reshape(-1, 3)])  # (k, 3)
    pa, pb = a.vertices @ axes.T, b.vertices @ axes.T  # (n, k), (m, k)
    reach = a.radius_m + b.radius_m
    over = np.minimum(pa.max(axis=0) - pb.min(axis=0), pb.max(axis=0) - pa.min(axis=0)) + reach
    return float(over.min())


class Solids:
    """Parts of walls and placed assets, each with a bounding box for a quick first test."""

    def __init__(self) -> None:
        self._parts: list[Convex] = []
        self._owners: list[str] = []
        self._boxes = np.empty((0, 6))

    @staticmethod
    def of_scene(scene: Scene) -> Solids:
        """Return walls, background and all objects of a scene with their joints shut."""
        solids = Solids()
        solids.add(BACKGROUND, [convex_of(part, IDENTITY) for part in scene.background_parts])
        solids.add(WALL, [convex_of(wall, IDENTITY) for wall in scene.walls])
        for item in scene.objects:
            solids.add(item.name, placed_parts(scene.assets[item.asset_id], item.pose_world_asset))
        return solids

    def add(self, owner: str, parts: Sequence[Convex]) -> None:
        rows = [[*part.low, *part.high] for part in parts]
        self._parts += parts
        self._owners += [owner] * len(parts)
        self._boxes = np.concatenate([self._boxes, np.asarray(rows).reshape(-1, 6)])

    def remove(self, owners: Container[str]) -> None:
        """Remove all parts of these owners."""
        kept = [index for index, owner in enumerate(self._owners) if owner not in owners]
        self._parts = [self._parts[index] for index in kept]
        self._owners = [self._owners[index] for index in kept]
        self._boxes = self._boxes[kept]

    def overlaps(
        self, parts: Iterable[Convex], *, ignore: str = "", tolerance_m: float = TOLERANCE_M
    ) -> dict[str, float]:
        """Return the owners that the parts overlap by more than the tolerance, with the greatest depth in metres."""
        found: dict[str, float] = {}
        for owner, depth in self._depths(parts, ignore, tolerance_m):
            if depth > max(tolerance_m, found.get(owner, 0.0)):
                found[owner] = depth
        return found

    def is_clear(self, parts: Iterable[Convex]) -> bool:
        """True if the parts overlap nothing by more than the tolerance."""
        return all(depth <= TOLERANCE_M for _, depth in self._depths(parts, "", TOLERANCE_M))

    def _depths(
        self, parts: Iterable[Convex], ignore: str, tolerance_m: float
    ) -> Iterator[tuple[str, float]]:
        """Yield owner and depth of each pair of parts whose boxes overlap by more than the tolerance."""
        for part in parts:
            apart = (self._boxes[:, :3] >= part.high - tolerance_m) | (
                self._boxes[:, 3:] <= part.low + tolerance_m
            )
            for index in np.flatnonzero(~apart.any(axis=1)):
                if self._owners[index] != ignore:
                    yield self._owners[index], depth_m(part, self._parts[index])


def placed_parts(asset: Asset, pose: Pose, fractions: Sequence[float] = ()) -> list[Convex]:
    """Return all parts of an asset at a pose, with its joints at these shares of their travel (default: shut)."""
    shares = iter(fractions)
    placed: list[Convex] = []
    for link in asset.links:
        share = next(shares, 0.0) if link.joint is not None else 0.0
        frame = pose @ joint_motion(link.joint, share) if link.joint is not None and share else pose
        placed += [convex_of(part, frame) for part in link.parts]
    return placed
