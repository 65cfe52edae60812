"""Building blocks of asset bodies: shells, doors, cavities and support surfaces.

All coordinates are in the asset's frame: origin at the centre of its box, front at +x, z up, joints closed, metres.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final, Self

from embomatrix.factory.assets.shapes import box, box_of, rounded
from embomatrix.world.asset import Interior, Joint, JointKind, Link, SupportSurface
from embomatrix.world.geometry import Aabb, ConvexPart, Pose, Vec2, Vec3

Proportions = tuple[Vec2, Vec2, Vec2]

OPEN_ABOVE_M: Final = 2.0
"""Clearance of a surface with no part of the asset above it; no room is higher."""
FULL: Final = (-1.0, 1.0)
"""Interval of `proportioned` from the low side of the box to the high side."""
FIT_M: Final = 0.002
"""Gap between a door and its frame, and between an interior and the walls of its cavity."""


@dataclass(slots=True)
class Body:
    """Parts, moving links, surfaces and cavities of one asset while a generator builds it."""

    parts: list[ConvexPart] = field(default_factory=list)
    moving: list[Link] = field(default_factory=list)
    supports: list[SupportSurface] = field(default_factory=list)
    interiors: list[Interior] = field(default_factory=list)

    def add_support(
        self, name: str, low: Vec2, high: Vec2, z: float, clearance_m: float = OPEN_ABOVE_M
    ) -> Self:
        """Add an open surface between two corners at height ``z``; return the body."""
        self.supports.append(_surface(name, low, high, z, clearance_m))
        return self

    def add_board(self, name: str, compartment: Aabb) -> Self:
        """Add the floor of a compartment as a surface between walls; return the body."""
        (x0, y0, z0), (x1, y1, z1) = compartment.low_m, compartment.high_m
        low, high = (x0 + FIT_M, y0 + FIT_M), (x1 - FIT_M, y1 - FIT_M)
        self.supports.append(replace(_surface(f"{name}_floor", low, high, z0, z1 - z0), framed=True))
        return self

    def add_interior(
        self,
        name: str,
        cavity: Aabb,
        closed_by: tuple[str, ...] = (),
        clearance_m: float = 0.0,
        link: str = "",
    ) -> Self:
        """Add a cavity and its floor, which both move with ``link`` if it is named; return the body.

        Set ``clearance_m`` above the cavity's height if objects may stick out of its top.
        """
        (x0, y0, z0), (x1, y1, z1) = cavity.low_m, cavity.high_m
        x0, y0, x1, y1 = x0 + FIT_M, y0 + FIT_M, x1 - FIT_M, y1 - FIT_M
        centre, size = ((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2), (x1 - x0, y1 - y0, z1 - z0)
        self.interiors.append(Interior(name, rounded(*centre), rounded(*size), closed_by, link))
        clearance = max(clearance_m, z1 - z0)
        surface = _surface(f"{name}_floor", (x0, y0), (x1, y1), z0, clearance)
        self.supports.append(replace(surface, interior=name, link=link))
        return self


def _surface(name: str, low: Vec2, high: Vec2, z: float, clearance_m: float) -> SupportSurface:
    (x0, y0), (x1, y1) = low, high
    size = rounded(x1 - x0, y1 - y0, clearance_m)
    return SupportSurface(name, rounded((x0 + x1) / 2, (y0 + y1) / 2, z), size[:2], size[2])


def centred(size_m: Vec3) -> Aabb:
    """Return the box of a model, centred on the origin of its asset frame."""
    x, y, z = (extent / 2 for extent in size_m)
    return Aabb((-x, -y, -z), (x, y, z))


def region(x: Vec2, y: Vec2, z: Vec2) -> Aabb:
    """Return the box with these intervals along x, y and z."""
    return Aabb((x[0], y[0], z[0]), (x[1], y[1], z[1]))


def spanning(box: Aabb, axis: int, span: Vec2) -> Aabb:
    """Return the box with another interval along one axis."""
    spans = [*zip(box.low_m, box.high_m, strict=True)]
    spans[axis] = span
    return region(*spans)


def proportioned(size_m: Vec3, rows: Sequence[Proportions]) -> list[ConvexPart]:
    """Return boxes whose edges are given as shares of the half extents, from -1 (low side) to 1 (high side)."""

    def edge(share: float, extent: float) -> float:
        if share < 0:
            return -extent / 2 + (share + 1) / 2 * extent
        return extent / 2 - (1 - share) / 2 * extent

    return [
        box(*([edge(span[end], extent) for span, extent in zip(row, size_m, strict=True)] for end in (0, 1)))
        for row in rows
    ]


def clamp(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@dataclass(frozen=True, slots=True)
class Walls:
    """Thickness of the six walls of a shell in metres. Zero leaves a side open."""

    back: float
    front: float
    right: float
    left: float
    bottom: float
    top: float


def shell(outer: Aabb, walls: Walls) -> tuple[list[ConvexPart], Aabb]:
    """Return boards around a cavity, edge to edge without overlap, and the cavity itself."""
    (x0, y0, z0), (x1, y1, z1) = outer.low_m, outer.high_m
    inner = region(
        (x0 + walls.back, x1 - walls.front),
        (y0 + walls.right, y1 - walls.left),
        (z0 + walls.bottom, z1 - walls.top),
    )
    (ix0, iy0, iz0), (ix1, iy1, iz1) = inner.low_m, inner.high_m
    boards = (
        (walls.bottom, (x0, y0, z0), (x1, y1, iz0)),
        (walls.top, (x0, y0, iz1), (x1, y1, z1)),
        (walls.right, (x0, y0, iz0), (x1, iy0, iz1)),
        (walls.left, (x0, iy1, iz0), (x1, y1, iz1)),
        (walls.back, (x0, iy0, iz0), (ix0, iy1, iz1)),
        (walls.front, (ix1, iy0, iz0), (x1, iy1, iz1)),
    )
    return [box(low, high) for thickness, low, high in boards if thickness], inner


class Hinge(StrEnum):
    """Edge that a panel turns about.

    It is always an outer edge. The panel therefore swings clear of the frame, stays within its own width, and covers no more
    of the opening than its thickness when open.
    """

    RIGHT = "right"  # vertical, at -y
    LEFT = "left"  # vertical, at +y
    BOTTOM = "bottom"  # horizontal, at the foot of a front: drops down
    BACK = "back"  # horizontal, at the back of a lid: lifts up
    FRONT = "front"  # horizontal, at the front of a lid: lifts up


def hinged(name: str, panel: Aabb, hinge: Hinge) -> Link:
    """Return a door, flap or lid that opens by a quarter turn."""
    (x0, y0, z0), (x1, y1, z1) = panel.low_m, panel.high_m
    _, cy, cz = panel.center_m
    origin: Vec3
    match hinge:
        case Hinge.RIGHT:
            origin, axis = (x1, y0, cz), (0.0, 0.0, -1.0)
        case Hinge.LEFT:
            origin, axis = (x1, y1, cz), (0.0, 0.0, 1.0)
        case Hinge.BOTTOM:
            origin, axis = (x1, cy, z0), (0.0, 1.0, 0.0)
        case Hinge.BACK:
            origin, axis = (x0, cy, z1), (0.0, -1.0, 0.0)
        case Hinge.FRONT:
            origin, axis = (x1, cy, z1), (0.0, 1.0, 0.0)
    return Link(
        name, (box_of(panel),), Joint(JointKind.REVOLUTE, rounded(*origin), axis, round(math.pi / 2, 6))
    )


def sliding(name: str, panel: Aabb, axis: Vec3, travel_m: float) -> Link:
    """Return a panel that slides along a straight rail."""
    centre = rounded(*panel.center_m)
    return Link(name, (box_of(panel),), Joint(JointKind.PRISMATIC, centre, axis, round(travel_m, 6)))


def raised(body: Body, lift_m: float) -> Body:
    """Return the body ``lift_m`` higher in its frame."""
    links = [
        Link(
            link.name,
            tuple(_raised_part(part, lift_m) for part in link.parts),
            link.joint and replace(link.joint, origin_m=_raised(link.joint.origin_m, lift_m)),
        )
        for link in body.moving
    ]
    return Body(
        [_raised_part(part, lift_m) for part in body.parts],
        links,
        [replace(item, center_m=_raised(item.center_m, lift_m)) for item in body.supports],
        [replace(item, center_m=_raised(item.center_m, lift_m)) for item in body.interiors],
    )


def stacked(lower: Body, upper: Body, lift_m: float) -> Body:
    """Join two bodies and raise the upper one. Names of links, surfaces and cavities must differ."""
    above = raised(upper, lift_m)
    return Body(
        lower.parts + above.parts,
        lower.moving + above.moving,
        lower.supports + above.supports,
        lower.interiors + above.interiors,
    )


def _raised(point: Vec3, lift_m: float) -> Vec3:
    return rounded(point[0], point[1], point[2] + lift_m)


def _raised_part(part: ConvexPart, lift_m: float) -> ConvexPart:
    return replace(part, pose=Pose(_raised(part.pose.position_m, lift_m), part.pose.quat_xyzw))
