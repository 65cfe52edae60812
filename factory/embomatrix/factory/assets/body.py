"""Bodies: how parts, doors, cavities and supports of an asset are put together.

Everything is in the asset's frame: origin at the centre of the box, front at +x, z up, joints closed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.factory.assets.shapes import box, box_of, rounded
from embomatrix.world.asset import Interior, Joint, JointKind, Link, SupportSurface
from embomatrix.world.geometry import Aabb, Pose

if TYPE_CHECKING:
    from embomatrix.world.geometry import ConvexPart, Vec2, Vec3

OPEN_ABOVE_M: Final = 2.0
"""Clearance of a surface in the open: nothing of the asset is above it, and rooms end soon after."""
FIT_M: Final = 0.002
"""Gap between a door and its frame, and between an interior and the walls of its cavity."""


@dataclass(slots=True)
class Body:
    """What a generator has built so far; the library turns it into an asset."""

    parts: list[ConvexPart] = field(default_factory=list)
    moving: list[Link] = field(default_factory=list)
    supports: list[SupportSurface] = field(default_factory=list)
    interiors: list[Interior] = field(default_factory=list)

    def add_support(
        self, name: str, low: Vec2, high: Vec2, z: float, clearance_m: float = OPEN_ABOVE_M
    ) -> None:
        """A surface in the open between two corners at height ``z``."""
        self.supports.append(_surface(name, low, high, z, clearance_m))

    def add_interior(
        self,
        name: str,
        cavity: Aabb,
        closed_by: tuple[str, ...] = (),
        clearance_m: float = 0.0,
        link: str = "",
    ) -> None:
        """A cavity and its floor, which ride on ``link`` where it has a name.

        ``clearance_m`` exceeds the cavity's height where things may stick out at the top.
        """
        (x0, y0, z0), (x1, y1, z1) = cavity.low_m, cavity.high_m
        x0, y0, x1, y1 = x0 + FIT_M, y0 + FIT_M, x1 - FIT_M, y1 - FIT_M
        centre, size = ((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2), (x1 - x0, y1 - y0, z1 - z0)
        self.interiors.append(Interior(name, rounded(*centre), rounded(*size), closed_by, link))
        clearance = max(clearance_m, z1 - z0)
        surface = _surface(f"{name}_floor", (x0, y0), (x1, y1), z0, clearance)
        self.supports.append(replace(surface, interior=name, link=link))


def _surface(name: str, low: Vec2, high: Vec2, z: float, clearance_m: float) -> SupportSurface:
    (x0, y0), (x1, y1) = low, high
    size = rounded(x1 - x0, y1 - y0, clearance_m)
    return SupportSurface(name, rounded((x0 + x1) / 2, (y0 + y1) / 2, z), size[:2], size[2])


def centred(size_m: Vec3) -> Aabb:
    """The box of a model in its asset frame."""
    x, y, z = (extent / 2 for extent in size_m)
    return Aabb((-x, -y, -z), (x, y, z))


def region(x: Vec2, y: Vec2, z: Vec2) -> Aabb:
    """Box from its intervals along x, y and z."""
    return Aabb((x[0], y[0], z[0]), (x[1], y[1], z[1]))


def clamp(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@dataclass(frozen=True, slots=True)
class Walls:
    """Thickness of the six walls of a shell, in metres; zero leaves the side open."""

    back: float
    front: float
    right: float
    left: float
    bottom: float
    top: float


def shell(outer: Aabb, walls: Walls) -> tuple[list[ConvexPart], Aabb]:
    """Boards around a cavity, edge to edge without overlap, and the cavity."""
    (x0, y0, z0), (x1, y1, z1) = outer.low_m, outer.high_m
    inner = region(
        (x0 + walls.back, x1 - walls.front),
        (y0 + walls.right, y1 - walls.left),
        (z0 + walls.bottom, z1 - walls.top),
    )
    (ix0, iy0, iz0), (ix1, iy1, iz1) = inner.low_m, inner.high_m
    parts = []
    if walls.bottom:
        parts.append(box((x0, y0, z0), (x1, y1, iz0)))
    if walls.top:
        parts.append(box((x0, y0, iz1), (x1, y1, z1)))
    if walls.right:
        parts.append(box((x0, y0, iz0), (x1, iy0, iz1)))
    if walls.left:
        parts.append(box((x0, iy1, iz0), (x1, y1, iz1)))
    if walls.back:
        parts.append(box((x0, iy0, iz0), (ix0, iy1, iz1)))
    if walls.front:
        parts.append(box((ix1, iy0, iz0), (x1, iy1, iz1)))
    return parts, inner


class Hinge(StrEnum):
    """The edge that a panel turns about. It is always an *outer* edge of the panel: so the panel swings clear of the
    frame, stays within its own width, and at the end covers no more of the mouth than its own thickness."""

    RIGHT = "right"  # vertical, at -y
    LEFT = "left"  # vertical, at +y
    BOTTOM = "bottom"  # horizontal, at the foot of a front: drops down
    BACK = "back"  # horizontal, at the back of a lid: lifts up
    FRONT = "front"  # horizontal, at the front of a lid: lifts up


def hinged(name: str, panel: Aabb, hinge: Hinge) -> Link:
    """A door, flap or lid that opens by a quarter turn."""
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
    """A panel that moves along a straight rail."""
    centre = rounded(*panel.center_m)
    return Link(name, (box_of(panel),), Joint(JointKind.PRISMATIC, centre, axis, round(travel_m, 6)))


def raised(body: Body, lift_m: float) -> Body:
    """The same body ``lift_m`` higher in its frame."""
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
    """Both bodies as one, the upper one raised. Their links, surfaces and cavities have different names."""
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
