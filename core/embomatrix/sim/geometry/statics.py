"""Rest poses proved by statics: the base lies on a level top, and the weight acts over it.

The proof replaces a settle for the common case of a flat object on a flat surface. It is one-sided: an object that it does not
cover, such as a ball, a nested bowl or an object across two boards, may still be stable and has to be settled.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.world.asset import Asset, JointKind
from embomatrix.world.geometry import IDENTITY, Aabb, ConvexPart, Pose, Shape, Vec2, Vec3

FLAT_M: Final = 5e-5
"""Points of a base up to this much above its lowest still touch the support."""
FALL_M: Final = 0.001
"""An object higher over a top falls too hard for a proof."""
MARGIN_M: Final = 0.003
MARGIN_SHARE: Final = 0.15
"""The weight acts at least this far within each edge of the supported area, and at least this share of the base's extent
across that edge: nearer, objects rock by up to 2 mm."""
CLEAR_M: Final = 0.001
"""Other parts of the support keep at least this distance from the object."""
LEVEL_COSINE: Final = math.cos(math.radians(1.0))
"""Friction holds objects on a slope of less than a degree."""
SHORTEST_M: Final = 1e-6
"""Shorter polygon edges have no direction."""
RIM_POINTS: Final = 16
ROUND_CORNERS: Final = 8
"""A base with more corners is round. Bullet lets a round base rock on the edge of a surface."""
SQUARE: Final = 1e-6


@dataclass(frozen=True, slots=True)
class Base:
    """Contact polygon of an upright object in the asset's frame: its corners, anticlockwise, and its height.

    The object's weight acts at the frame's origin.
    """

    corners_m: tuple[Vec2, ...]
    height_m: float


def base_of(asset: Asset) -> Base | None:
    """Contact polygon of an asset without joints; None if it stands on an edge or a point, or its weight is outside."""
    if asset.joints:
        return None
    points = [point for link in asset.links for part in link.parts for point in _underside(part)]
    low = bounds_of(asset).box(IDENTITY).low_m[2]
    corners = _hull([(x, y) for x, y, z in points if z <= low + FLAT_M])
    if not corners:
        return None
    return Base(corners, low) if _bears((0.0, 0.0), corners, corners) else None


def rest_pose(held: Asset, base: Base, pose: Pose, support: Asset, fractions: Sequence[float]) -> Pose | None:
    """Rest pose, in the frame of its support, of an object that is let go at a pose; None if it is not proved.

    The proof requires: the object is upright just over the level top of one part, its weight acts over the supported area of
    its base, and no other part of the support comes near it. ``fractions`` are the support's joints; the support itself is
    level.
    """
    x, y, z, w = pose.quat_xyzw
    if x or y:
        return None
    cosine, sine = w * w - z * z, 2 * w * z
    px, py, pz = pose.position_m
    low = pz + base.height_m
    corners = [(px + cosine * u - sine * v, py + sine * u + cosine * v) for u, v in base.corners_m]
    box = bounds_of(held).box(pose)
    near = Aabb((box.low_m[0], box.low_m[1], low - FALL_M), box.high_m).grown(CLEAR_M)
    found: float | None = None
    for part, part_box in _parts_near(support, fractions, near):
        top = part_box.high_m[2]
        reaches = 0.0 <= low - top <= FALL_M
        if reaches and part is not None and _bears((px, py), _borne(corners, part, part_box), corners):
            found = top if found is None else max(found, top)
        elif top > low - FALL_M:
            return None
    return Pose((px, py, pz - (low - found)), pose.quat_xyzw) if found is not None else None


def is_level(pose: Pose) -> bool:
    """Return True if the vertical axis leans by less than a degree."""
    x, y, _, _ = pose.quat_xyzw
    return 1 - 2 * (x * x + y * y) >= LEVEL_COSINE


def _parts_near(
    support: Asset, fractions: Sequence[float], near: Aabb
) -> Iterator[tuple[ConvexPart | None, Aabb]]:
    """Boxes of a support's parts that overlap a box, in the support's frame, each with its part; None for a rotated part."""
    boxes = iter(bounds_of(support).part_boxes(IDENTITY, fractions))
    moving = iter(fractions)
    for link in support.links:
        joint = link.joint
        turned = joint is not None and next(moving) != 0.0 and joint.kind is JointKind.REVOLUTE
        for part, box in zip(link.parts, boxes, strict=False):
            if box.overlaps(near):
                yield None if turned else part, box


def _borne(corners: Sequence[Vec2], part: ConvexPart, box: Aabb) -> Sequence[Vec2]:
    """Area of a convex polygon that the top of a part supports; empty unless the part is an upright box.

    Bullet lets objects creep and rock by up to 0.6 mm on the cap of a cylinder, so a settle decides there.
    """
    (low_x, low_y, _), (high_x, high_y, _) = box.low_m, box.high_m
    x, y, z, w = (abs(value) for value in part.pose.quat_xyzw)
    if max(x, y) > SQUARE:
        return ()
    if part.shape is not Shape.BOX or min(z, w, abs(z - w)) > SQUARE:
        return ()
    for axis, edge, sign in ((0, low_x, 1), (0, high_x, -1), (1, low_y, 1), (1, high_y, -1)):
        clipped = _clipped(corners, axis, edge, sign)
        if clipped is not corners and len(corners) > ROUND_CORNERS:
            return ()
        corners = clipped
    return corners


def _clipped(corners: Sequence[Vec2], axis: int, edge: float, sign: int) -> Sequence[Vec2]:
    """Part of a convex polygon on one side of a line along an axis: Sutherland and Hodgman 1974."""
    inside = [sign * (corner[axis] - edge) >= 0.0 for corner in corners]
    if all(inside):
        return corners
    found: list[Vec2] = []
    for number, corner in enumerate(corners):
        before = corners[number - 1]
        if inside[number] != inside[number - 1]:
            share = (edge - before[axis]) / (corner[axis] - before[axis])
            x, y = (a + share * (b - a) for a, b in zip(before, corner, strict=True))
            found.append((x, y))
        if inside[number]:
            found.append(corner)
    return found


def _bears(point: Vec2, corners: Sequence[Vec2], base: Sequence[Vec2]) -> bool:
    """Return True if a point lies within a convex anticlockwise polygon, a margin away from each edge.

    The margin grows with the extent of ``base`` across the edge.
    """
    x, y = point
    edges = 0
    for number, (to_x, to_y) in enumerate(corners):
        from_x, from_y = corners[number - 1]
        along_x, along_y = to_x - from_x, to_y - from_y
        length = math.hypot(along_x, along_y)
        if length < SHORTEST_M:
            continue
        edges += 1
        across = [(along_x * v - along_y * u) / length for u, v in base]
        margin_m = max(MARGIN_M, MARGIN_SHARE * (max(across) - min(across)))
        if along_x * (y - from_y) - along_y * (x - from_x) < margin_m * length:
            return False
    return edges > 2


def _underside(part: ConvexPart) -> list[Vec3]:
    """Candidates for the lowest points of a part, in the asset's frame. A sphere has none: it rests on a point."""
    match part.shape:
        case Shape.BOX | Shape.HULL:
            local = part.corners().tolist()
        case Shape.CYLINDER:
            x, _, z = (extent / 2 for extent in part.size_m)
            local = [(x * u, x * v, t) for u, v in _circle() for t in (-z, z)]
        case Shape.SPHERE:
            local = []
    return [part.pose.apply((x, y, z)) for x, y, z in local]


@functools.cache
def _circle() -> tuple[Vec2, ...]:
    angles = (number * math.tau / RIM_POINTS for number in range(RIM_POINTS))
    return tuple((math.cos(angle), math.sin(angle)) for angle in angles)


def _hull(points: Sequence[Vec2]) -> tuple[Vec2, ...]:
    """Corners of the convex hull, anticlockwise: Andrew's monotone chain."""
    ordered = sorted(set(points))
    if len(ordered) < 3:
        return ()
    return tuple(_chain(ordered)[:-1] + _chain(ordered[::-1])[:-1])


def _chain(points: Sequence[Vec2]) -> list[Vec2]:
    chain: list[Vec2] = []
    for x, y in points:
        while len(chain) > 1:
            (ax, ay), (bx, by) = chain[-2:]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                break
            chain.pop()
        chain.append((x, y))
    return chain
