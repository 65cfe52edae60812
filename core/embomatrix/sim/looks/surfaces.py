"""Surfaces of a scene's parts at the points that a picture shows: normals, and positions on their textures."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from embomatrix.sim.looks.materials import Material, Pattern
from embomatrix.world.geometry import ConvexPart, Pose, Shape

FloatArray = NDArray[np.float32]
IntArray = NDArray[np.signedinteger[Any]]

_SHAPES: Final = tuple(Shape)
_PATTERNS: Final = tuple(Pattern)
_LABELS: Final = np.array([pattern is Pattern.LABEL for pattern in Pattern])
"""Labels go round the sides of a part; other patterns that fill a face are on the two largest faces."""
_UP: Final = 2
_FLATTEST: Final = 0.05
"""Least cosine of the angle at which textures are seen."""
_MARGIN: Final = 0.004
"""Position at the margin of a tile, whose colour the other faces have."""
_ROUNDING: Final = 0.07
"""Share of a hull's size over which its edges look rounded."""
THINNEST_M: Final = 0.002
"""Thinner boxes are drawn this thick."""
_FACE_AXES: Final = np.array([(1, 2), (0, 2), (0, 1)])
"""Axes of the texture on faces across x, y and z."""


@dataclass(frozen=True)
class PartTable:
    """Parts of a scene as arrays, one row each.

    ``half_m`` holds half the extents of their boxes, ``color`` is linear, ``traits`` holds gloss, metal and glow.
    ``hulls`` maps rows to the planes of convex hulls, shape (faces, 4).
    """

    position_m: FloatArray
    rotation: FloatArray
    half_m: FloatArray
    shape: IntArray
    color: FloatArray
    traits: FloatArray
    pattern: IntArray
    hulls: dict[int, FloatArray]


@dataclass(frozen=True)
class SurfacePoints:
    """Points on parts: rows of the table, normals in the world, and positions on the texture in units of tiles."""

    row: IntArray
    normal: FloatArray
    u: FloatArray
    v: FloatArray
    tile_m: FloatArray
    """Size of a tile at the point, the smaller side."""
    slant: FloatArray
    """Share of its length that a short line on the surface has in the picture, in the mean of both directions."""


def table_of(parts: Sequence[tuple[ConvexPart, Pose, Material]], planes: "HullPlanes") -> PartTable:
    """Return the table of parts at poses in the world, with their materials."""
    quats = np.array([pose.quat_xyzw for _, pose, _ in parts]).reshape(-1, 4)
    shapes = np.array([_SHAPES.index(part.shape) for part, _, _ in parts], np.intp)
    sizes = np.array([part.size_m for part, _, _ in parts]).reshape(-1, 3)
    return PartTable(
        position_m=np.array([pose.position_m for _, pose, _ in parts], np.float32).reshape(-1, 3),
        rotation=_rotations(quats).astype(np.float32),
        half_m=(np.maximum(sizes, THINNEST_M) / 2).astype(np.float32),
        shape=shapes,
        color=np.array([material.color for _, _, material in parts], np.float32).reshape(-1, 3) ** 2.2,
        traits=np.array([(m.gloss, m.metal, m.glow) for _, _, m in parts], np.float32).reshape(-1, 3),
        pattern=np.array([_PATTERNS.index(m.pattern) for _, _, m in parts], np.intp),
        hulls={
            row: planes.of(parts[row][0])
            for row in np.flatnonzero(shapes == _SHAPES.index(Shape.HULL)).tolist()
        },
    )


class HullPlanes:
    """Planes of convex hulls, computed once for each shape."""

    def __init__(self) -> None:
        self._planes: dict[tuple[object, ...], FloatArray] = {}

    def of(self, part: ConvexPart) -> FloatArray:
        """Return outward unit normals and offsets, shape (faces, 4)."""
        planes = self._planes.get(part.vertices_m)
        if planes is None:
            found = ConvexHull(np.asarray(part.vertices_m)).equations
            planes = np.unique(np.round(found, 6), axis=0).astype(np.float32)
            self._planes[part.vertices_m] = planes
        return planes


def surface_points(
    table: PartTable, row: IntArray, points: FloatArray, rays: FloatArray, tile_m: FloatArray
) -> SurfacePoints:
    """Return the surfaces at points, shape (n, 3), on the parts of ``row``, seen along ``rays``.

    ``tile_m`` gives the tile size of each pattern.
    """
    rotation = table.rotation[row]  # (n, 3, 3)
    local = np.einsum("nij,ni->nj", rotation, points - table.position_m[row])
    half = table.half_m[row]
    normal = _local_normals(table, row, local, half)
    # Faces of boxes have one axis; round shapes take the nearest.
    axis = np.argmax(np.abs(normal), axis=1)
    across, along = _FACE_AXES[axis].T
    number = np.arange(len(row))
    a, b = local[number, across], local[number, along]
    wide, high = half[number, across], half[number, along]
    tile = tile_m[table.pattern[row]]
    fills = tile == 0.0
    # Grain and planks run along the longer side of a part.
    turned = ~fills & (high > wide)
    a, b = np.where(turned, b, a), np.where(turned, a, b)
    thinnest = np.argmin(half, axis=1)
    blank = fills & np.where(_LABELS[table.pattern[row]], axis == _UP, axis != thinnest)
    salt = (row % 97) * np.float32(0.131)
    u = np.where(fills, a / (2 * wide) + 0.5, a / np.where(fills, 1.0, tile) + salt)
    v = np.where(fills, 0.5 - b / (2 * high), b / np.where(fills, 1.0, tile) + salt)
    u[blank] = v[blank] = _MARGIN
    size = np.where(fills, 2 * np.minimum(wide, high), tile)
    world = np.einsum("nij,nj->ni", rotation, normal)
    toward = np.einsum("ni,ni->n", world, rays)
    # Thin parts, such as ceilings, are seen from both sides.
    world[toward > 0] *= -1
    return SurfacePoints(
        row,
        world,
        u.astype(np.float32),
        v.astype(np.float32),
        size.astype(np.float32),
        np.sqrt(np.maximum(np.abs(toward), _FLATTEST)),
    )


def _local_normals(table: PartTable, row: IntArray, local: FloatArray, half: FloatArray) -> FloatArray:
    shape = table.shape[row]
    gap = half - np.abs(local)
    nearest = np.argmin(gap, axis=1)
    normal = np.zeros_like(local)
    number = np.arange(len(row))
    normal[number, nearest] = np.where(local[number, nearest] < 0, -1.0, 1.0)
    for kind in np.unique(shape).tolist():
        chosen = np.flatnonzero(shape == kind)
        match _SHAPES[kind]:
            case Shape.CYLINDER:
                normal[chosen] = _cylinder_normals(local[chosen], half[chosen])
            case Shape.SPHERE:
                length = np.linalg.norm(local[chosen], axis=1, keepdims=True)
                normal[chosen] = local[chosen] / np.maximum(length, 1e-6)
            case Shape.HULL:
                _hull_normals(table, row, local, chosen, normal)
            case Shape.BOX:
                pass
    return normal


def _cylinder_normals(local: FloatArray, half: FloatArray) -> FloatArray:
    radius = np.hypot(local[:, 0], local[:, 1])
    cap = half[:, 2] - np.abs(local[:, 2]) < half[:, 0] - radius
    side = (
        np.stack([local[:, 0], local[:, 1], np.zeros_like(radius)], axis=1)
        / np.maximum(radius, 1e-6)[:, None]
    )
    top = np.zeros_like(local)
    top[:, 2] = np.sign(local[:, 2])
    return np.where(cap[:, None], top, side)


def _hull_normals(
    table: PartTable, row: IntArray, local: FloatArray, chosen: IntArray, normal: FloatArray
) -> None:
    """Set normals of points on hulls: a mean of the faces nearby, so that fruit and bottles look round."""
    order = chosen[np.argsort(row[chosen], kind="stable")]
    found, first = np.unique(row[order], return_index=True)
    for part, points in zip(found.tolist(), np.split(order, first[1:]), strict=True):
        planes = table.hulls[part]
        height = local[points] @ planes[:, :3].T + planes[:, 3]  # (m, faces), 0 on a face
        softness = _ROUNDING * 2 * float(table.half_m[part].max())
        weight = np.exp((height - height.max(axis=1, keepdims=True)) / softness)
        mean = weight @ planes[:, :3]
        normal[points] = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-6)


def _rotations(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices of unit quaternions (x, y, z, w), shape (n, 3, 3)."""
    x, y, z, w = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
