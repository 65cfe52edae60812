"""Convex parts of assets: boxes, octagons and rings of boxes, prisms and rounded lumps, in the asset's frame, in metres.

Unit shapes are hulls computed once with trimesh; a part of an asset is a scaled copy. `mesh_of` turns a part back into a
mesh, for pictures and for checks of volume.
"""

import functools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import trimesh

from embomatrix.world.geometry import Aabb, ConvexPart, FloatArray, Pose, Shape, Vec2, Vec3

DECIMALS: Final = 6
"""Coordinates are rounded to 1 µm, so that equal models give equal bytes on every machine."""

_SLANT: Final = math.tan(math.pi / 8)
_OCTAGON: Final = (
    (1.0, -_SLANT), (1.0, _SLANT), (_SLANT, 1.0), (-_SLANT, 1.0),
    (-1.0, _SLANT), (-1.0, -_SLANT), (-_SLANT, -1.0), (_SLANT, -1.0),
)  # fmt: skip
"""Corners of the octagon about the unit circle, anticlockwise.

A vessel's bottom (3 boxes), wall (8 boxes) and handles stay below the 16 parts that a link may have.
"""


def rounded(*values: float) -> Vec3:
    """Round three coordinates; negative zero becomes zero."""
    x, y, z = (round(float(value), DECIMALS) + 0.0 for value in values)
    return (x, y, z)


def box(low: Sequence[float], high: Sequence[float]) -> ConvexPart:
    """Return the axis-aligned box between two corners. Raises ValueError if a side is shorter than 0.1 mm."""
    size = [b - a for a, b in zip(low, high, strict=True)]
    if min(size) < 1e-4:
        raise ValueError(f"box from {tuple(low)} to {tuple(high)} m has no volume: expected low < high")
    centre = rounded(*((a + b) / 2 for a, b in zip(low, high, strict=True)))
    return ConvexPart(Shape.BOX, Pose(centre), rounded(*size))


def box_of(region: Aabb) -> ConvexPart:
    return box(region.low_m, region.high_m)


def hull(points: FloatArray) -> ConvexPart:
    """Return a convex part from the corners of a hull, shape (n, 3). Its origin is the centre of their bounding box."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre = rounded(*((low + high) / 2))
    vertices = tuple(rounded(*point) for point in (points - np.asarray(centre)))
    return ConvexPart(Shape.HULL, Pose(centre), rounded(*(high - low)), vertices)


def prism(centre: Vec2, radii: Vec2, z: Vec2) -> ConvexPart:
    """Return an upright elliptic cylinder as a prism of twelve sides; ``radii`` are its half extents along x and y."""
    rim = _polygon(12) * radii + centre
    return hull(np.vstack([np.column_stack((rim, np.full(12, height))) for height in z]))


def shouldered(radii: Vec2, neck_share: float, z: Vec3) -> ConvexPart:
    """Return a bottle: upright to the shoulder at the second height, then narrowing to the neck's share of the radii."""
    rims = ((1.0, z[0]), (1.0, z[1]), (neck_share, z[2]))
    levels = [np.column_stack((_polygon(12) * radii * share, np.full(12, height))) for share, height in rims]
    return hull(np.vstack(levels))


def octagon(centre: Vec2, radii: Vec2, z: Vec2) -> list[ConvexPart]:
    """Return a flat disc as three boxes that cover an octagon except for slivers at its slanted sides.

    Boxes share one compound in Bullet and rest on each other without rocking. Hulls and cylinders do neither.
    """
    (cx, cy), (rx, ry), (z0, z1) = centre, radii, z
    return [
        box((cx - a * rx, cy - b * ry, z0), (cx + a * rx, cy + b * ry, z1))
        for a, b in ((1.0, _SLANT), (_SLANT, 1.0), (math.sqrt(0.5), math.sqrt(0.5)))
    ]


def ring(centre: Vec2, radii: Vec2, z: Vec2, wall_m: float) -> list[ConvexPart]:
    """Return the wall of a round vessel: eight boards whose outer faces are the sides of the octagon."""
    corners = np.array(_OCTAGON) * radii + centre  # (8, 2)
    boards = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = end - start
        length = float(np.hypot(*along))
        outward = np.array((along[1], -along[0])) / length
        x, y = (start + end) / 2 - outward * wall_m / 2
        yaw = math.atan2(outward[1], outward[0])
        turn = (0.0, 0.0, round(math.sin(yaw / 2), 9), round(math.cos(yaw / 2), 9))
        size = rounded(wall_m, length, z[1] - z[0])
        boards.append(ConvexPart(Shape.BOX, Pose(rounded(x, y, (z[0] + z[1]) / 2), turn), size))
    return boards


def inscribed(radii: Vec2, wall_m: float) -> Vec2:
    """Return the half extents of the rectangle inscribed in a ring with walls of this thickness."""
    rx, ry = radii
    share = math.sqrt(0.5) - wall_m / 2 * math.hypot(1 / rx, 1 / ry)
    return (share * rx, share * ry)


def lump(region: Aabb) -> ConvexPart:
    """Return an ellipsoid-like hull with a flat base that fills a box.

    A true ellipsoid would roll for ever in a rigid-body engine, which has no rolling friction.
    """
    return _stretched(_lathe(_LUMP), region)


def dome(region: Aabb) -> ConvexPart:
    """Return half an ellipsoid on its cut face: halves of fruit, buns, heaps, boulders, bushes."""
    return _stretched(_lathe(_DOME), region)


def cushion(region: Aabb) -> ConvexPart:
    """Return a box with its edges cut: pillows, bags, shoes."""
    return _stretched(_unit_cushion(), region)


def loaf(region: Aabb) -> ConvexPart:
    """Return a bar along the longer side with an arched back: bread, pastry."""
    return _extruded(region, _LOAF, ((0.0, 1.0), (1.0, 1.0)))


def log(region: Aabb) -> ConvexPart:
    """Return a round bar along the longer side: logs, rolls, torches.

    One of its eight sides lies flat on the ground, so it does not roll.
    """
    return _extruded(region, _ROUND, ((0.0, 1.0), (1.0, 1.0)))


def capsule(region: Aabb) -> ConvexPart:
    """Return a lying bar with rounded ends: sausages, carrots, bananas."""
    return _extruded(
        region, _ROUND, ((0.0, 0.45), (0.15, 0.9), (0.3, 1.0), (0.7, 1.0), (0.85, 0.9), (1.0, 0.45))
    )


def ridge(region: Aabb) -> ConvexPart:
    """Return a prism with a ridge along the longer side: tents and roofs."""
    return _extruded(region, ((0.0, 0.0), (1.0, 0.0), (0.5, 1.0)), ((0.0, 1.0), (1.0, 1.0)))


def frustum(region: Aabb, top_share: float) -> ConvexPart:
    """Return a block that narrows towards the top to a share of its base: folded cloth."""
    (x0, y0, z0), (x1, y1, z1) = region.low_m, region.high_m
    (cx, cy, _), share = region.center_m, top_share
    top = [(cx + share * (x - cx), cy + share * (y - cy), z1) for x in (x0, x1) for y in (y0, y1)]
    return hull(np.array([*((x, y, z0) for x in (x0, x1) for y in (y0, y1)), *top]))


def wedge(region: Aabb) -> ConvexPart:
    """Return a slice of cake: a triangle seen from above, with its tip at the end of the longer side."""
    (x0, y0, z0), (x1, y1, z1) = region.low_m, region.high_m
    cx, cy, _ = region.center_m
    tip = ((x0, y0), (x0, y1), (x1, cy)) if x1 - x0 >= y1 - y0 else ((x0, y0), (x1, y0), (cx, y1))
    return hull(np.array([(x, y, z) for z in (z0, z1) for x, y in tip]))


def half_disc(region: Aabb) -> ConvexPart:
    """Return half a disc; its straight edge is the longer side."""
    turn = np.linspace(0.0, math.pi, 9)
    along, out = (1 - np.cos(turn)) / 2, np.sin(turn)
    out[-1] = 0.0
    (x0, y0, z0), size = region.low_m, region.size_m
    rim = np.column_stack((out, along) if size[1] >= size[0] else (along, out)) * size[:2] + (x0, y0)
    return hull(np.vstack([np.column_stack((rim, np.full(9, z))) for z in (z0, region.high_m[2])]))


_LOAF: Final = ((0.0, 0.0), (1.0, 0.0), (1.0, 0.55), (0.78, 0.92), (0.5, 1.0), (0.22, 0.92), (0.0, 0.55))
_LUMP: Final = ((-0.5, 0.26), (-0.33, 0.42), (-0.05, 0.5), (0.25, 0.43), (0.5, 0.16))
_DOME: Final = ((-0.5, 0.5), (-0.1, 0.48), (0.3, 0.34), (0.5, 0.12))
_ROUND: Final = tuple((0.5 + x / 2, 0.5 + y / 2) for x, y in _OCTAGON)


def _extruded(region: Aabb, section: Sequence[Vec2], stations: Sequence[Vec2]) -> ConvexPart:
    """Extrude a section in the unit square (across, up) along the longer horizontal side.

    ``stations`` lists pairs: share of the length, scale of the section about its centre.
    """
    size = np.asarray(region.size_m)
    flat = np.asarray(section) - 0.5  # (n, 2)
    rings = [np.column_stack((np.full(len(flat), share - 0.5), flat * scale)) for share, scale in stations]
    points = np.vstack(rings)  # along, across, up
    if size[1] > size[0]:
        points = points[:, (1, 0, 2)]
    return hull(points * size + np.asarray(region.center_m))


def _stretched(unit: FloatArray, region: Aabb) -> ConvexPart:
    return hull(unit * np.asarray(region.size_m) + np.asarray(region.center_m))


@functools.cache
def _polygon(sides: int) -> FloatArray:
    """Return the corners of the regular polygon in the unit circle, shape (sides, 2), the first at +x."""
    turn = 2 * math.pi * np.arange(sides) / sides
    return np.column_stack((np.cos(turn), np.sin(turn)))


@functools.cache
def _unit_cushion() -> FloatArray:
    inset = 0.34
    rims = [(-0.5, inset), (-0.15, 0.5), (0.15, 0.5), (0.5, inset)]
    corners = [(sx, sy) for sx in (-1, 1) for sy in (-1, 1)]
    return _hull_corners(np.array([(sx * half, sy * half, z) for z, half in rims for sx, sy in corners]))


@functools.cache
def _lathe(profile: tuple[Vec2, ...]) -> FloatArray:
    """Return the corners of a solid of revolution in the unit box; ``profile`` lists (height, radius)."""
    rims = [np.column_stack((_polygon(12) * radius, np.full(12, z))) for z, radius in profile]
    return _hull_corners(np.vstack(rims))


def _hull_corners(points: FloatArray) -> FloatArray:
    """Return the corners of the convex hull in the given order; points inside the hull are dropped."""
    corners = trimesh.convex.convex_hull(points).vertices
    kept = [point for point in points if np.abs(corners - point).max(axis=1).min() < 1e-9]
    return np.asarray(kept, dtype=np.float64)


def mesh_of(part: ConvexPart) -> trimesh.Trimesh:
    """Return the closed triangle mesh of a part in the asset's frame."""
    match part.shape:
        case Shape.BOX:
            mesh: trimesh.Trimesh = trimesh.creation.box(extents=part.size_m)
        case Shape.CYLINDER:
            mesh = trimesh.creation.cylinder(radius=part.size_m[0] / 2, height=part.size_m[2], sections=24)
        case Shape.SPHERE:
            mesh = trimesh.creation.icosphere(radius=part.size_m[0] / 2, subdivisions=2)
        case Shape.HULL:
            mesh = trimesh.convex.convex_hull(np.asarray(part.vertices_m))
    transform = np.eye(4)
    transform[:3, :3] = part.pose.rotation
    transform[:3, 3] = part.pose.position_m
    mesh.apply_transform(transform)
    return mesh
