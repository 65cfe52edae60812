"""Round objects: bowls, pots, pans, cups, glasses, plates, bottles, jars and pots with a lid."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from embomatrix.factory.assets.body import (
    FIT_M,
    OPEN_ABOVE_M,
    Body,
    Hinge,
    centred,
    clamp,
    hinged,
    region,
    spanning,
    stacked,
)
from embomatrix.factory.assets.cabinets import SHALLOW_M
from embomatrix.factory.assets.shapes import box, box_of, inscribed, octagon, prism, ring, shouldered
from embomatrix.world.geometry import Aabb, ConvexPart, Vec2, Vec3


class Handle(StrEnum):
    """Handles of a vessel. They fill the part of the box beyond the round body."""

    NONE = "none"
    ONE = "one"  # at one end of the longer side: mugs, pans, jugs
    BOTH = "both"  # at both ends: pots, casseroles, teapots with their spout


@dataclass(frozen=True, slots=True)
class VesselStyle:
    """Proportions of a vessel.

    ``wall_share`` is the wall's thickness as a share of the smaller radius; ``stem_share`` the height of foot and stem as a
    share of the whole.
    """

    handle: Handle = Handle.NONE
    wall_share: float = 0.08
    stem_share: float = 0.0


OPEN_ROUND: Final = VesselStyle()
CUP: Final = VesselStyle(Handle.ONE)
GOBLET: Final = VesselStyle(stem_share=0.45)
PAN: Final = VesselStyle(Handle.ONE, wall_share=0.04)
POT: Final = VesselStyle(Handle.BOTH, wall_share=0.05)


@dataclass(frozen=True, slots=True)
class _Round:
    """Round body of a vessel: centre and outer radii at the rim."""

    centre: Vec2
    radii: Vec2


def vessel(size_m: Vec3, style: VesselStyle) -> Body:
    """A bottom, a wall of eight boards, and handles; the cavity is open above."""
    outer = centred(size_m)
    body = Body()
    shape = _round(outer, style.handle)
    z0, z1 = outer.low_m[2], outer.high_m[2]
    if style.stem_share:
        z0 = _stem(body, shape, (z0, z1), style.stem_share)
    _cup(body, shape, (z0, z1), style)
    body.parts.extend(_handles(outer, shape, style.handle))
    return body


def _cup(body: Body, shape: _Round, z: Vec2, style: VesselStyle, closed_by: tuple[str, ...] = ()) -> None:
    """Add bottom, wall and cavity between two heights."""
    z0, z1 = z
    thin = min(shape.radii)
    wall = clamp(style.wall_share * thin, min(0.003, 0.2 * thin), 0.03)
    floor = z0 + clamp(0.08 * (z1 - z0), 0.0015, 0.012)
    body.parts.extend(octagon(shape.centre, shape.radii, (z0, floor)))
    body.parts.extend(ring(shape.centre, shape.radii, (floor, z1), wall))
    half_x, half_y = inscribed(shape.radii, wall)
    cx, cy = shape.centre
    if z1 - floor >= SHALLOW_M:
        cavity = region((cx - half_x, cx + half_x), (cy - half_y, cy + half_y), (floor, z1))
        body.add_interior("inside", cavity, closed_by, 0.0 if closed_by else OPEN_ABOVE_M)
    else:
        body.add_support("floor", (cx - half_x, cy - half_y), (cx + half_x, cy + half_y), floor)


def _round(outer: Aabb, handle: Handle) -> _Round:
    """Return the round body within the box. Handles get at most 40 % of the longer side, so that the vessel stands."""
    half = list(outer.high_m[:2])
    long = 0 if half[0] > half[1] else 1
    if handle is Handle.NONE or half[long] < 1.08 * half[1 - long]:
        return _Round((0.0, 0.0), (half[0], half[1]))
    body_half = max(half[1 - long], 0.6 * half[long])
    centre = [0.0, 0.0]
    if handle is Handle.ONE:
        centre[long] = body_half - half[long]
    half[long] = body_half
    return _Round((centre[0], centre[1]), (half[0], half[1]))


def _handles(outer: Aabb, shape: _Round, handle: Handle) -> list[ConvexPart]:
    """Return bars from the body to the ends of the box, near the rim."""
    long = 0 if outer.size_m[0] > outer.size_m[1] else 1
    reach = shape.centre[long] + shape.radii[long]
    if handle is Handle.NONE or outer.high_m[long] - reach < 1e-3:
        return []
    height, width = outer.size_m[2], clamp(0.12 * min(outer.size_m[:2]), 0.004, 0.03)
    z = (outer.high_m[2] - 0.45 * height, outer.high_m[2] - 0.15 * height)
    spans = [(reach, outer.high_m[long])]
    if handle is Handle.BOTH:
        spans.append((-spans[0][1], -spans[0][0]))
    bars = []
    for low, high in spans:
        along, across = (low, high), (-width / 2, width / 2)
        x, y = (along, across) if long == 0 else (across, along)
        bars.append(box((x[0], y[0], z[0]), (x[1], y[1], z[1])))
    return bars


def _stem(body: Body, shape: _Round, z: Vec2, share: float) -> float:
    """Add foot and stem of a goblet; return the height at which its cup begins."""
    z0, z1 = z
    top = z0 + share * (z1 - z0)
    foot = z0 + 0.05 * (z1 - z0)
    thin = 0.16 * min(shape.radii)
    wide = (0.85 * shape.radii[0], 0.85 * shape.radii[1])
    body.parts.extend([*octagon((0.0, 0.0), wide, (z0, foot)), box((-thin, -thin, foot), (thin, thin, top))])
    return top


def lidded_vessel(size_m: Vec3) -> Body:
    """A pot or jar with a lid that is hinged at the back."""
    outer = centred(size_m)
    shape = _Round((0.0, 0.0), outer.high_m[:2])
    lid = clamp(0.1 * size_m[2], 0.004, 0.04)
    style = VesselStyle(wall_share=max(0.06, 2 * lid / min(size_m[:2])))
    z1 = outer.high_m[2] - lid
    panel = spanning(outer, 2, (z1 + min(FIT_M, 0.2 * lid), outer.high_m[2]))
    body = Body(moving=[hinged("lid", panel, Hinge.BACK)])
    _cup(body, shape, (outer.low_m[2], z1), style, ("lid",))
    return body


def blender(size_m: Vec3) -> Body:
    """A motor block that carries a lidded jar."""
    outer = centred(size_m)
    motor = 0.35 * size_m[2]
    jar = lidded_vessel((size_m[0], size_m[1], size_m[2] - motor))
    block = box_of(spanning(outer, 2, (outer.low_m[2], outer.low_m[2] + motor)))
    return stacked(Body([block]), jar, motor / 2)


def plate(size_m: Vec3) -> Body:
    """A flat disc without a rim, so that food may reach over its edge: a steak is larger than most plates."""
    (_, _, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    body = Body(octagon((0.0, 0.0), (x1, y1), (z0, z1)))
    return body.add_support("top", (-0.7 * x1, -0.7 * y1), (0.7 * x1, 0.7 * y1), z1)


def bottle(size_m: Vec3) -> Body:
    """A closed body with a neck; a plain box if the catalog's model lies on its side."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    if size_m[2] < 0.8 * max(size_m[:2]):
        return Body(parts=[box((x0, y0, z0), (x1, y1, z1))])
    return Body(parts=[shouldered((x1, y1), 0.35, (z0, z0 + 0.68 * size_m[2], z1))])


def can(size_m: Vec3) -> Body:
    """A closed cylinder with a flat top: cans, jars, candles, cakes, upright rolls."""
    (_, _, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    return Body(parts=[prism((0.0, 0.0), (x1, y1), (z0, z1))])
