"""Small loose things: food, cutlery, soft goods. All have a flat base, so that they rest where they are put."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.factory.assets.body import Body, centred
from embomatrix.factory.assets.shapes import box, cushion, dome, lump, prism

if TYPE_CHECKING:
    from embomatrix.world.geometry import Vec3


def round_food(size_m: Vec3) -> Body:
    """Fruit, vegetables, roasts: an ellipsoid with a dent to rest on; flat ones are discs."""
    if size_m[2] < 0.35 * min(size_m[:2]):
        return disc(size_m)
    return Body(parts=[lump(centred(size_m))])


def half_food(size_m: Vec3) -> Body:
    """A half on its cut face."""
    if size_m[2] < 0.25 * min(size_m[:2]):
        return disc(size_m)
    return Body(parts=[dome(centred(size_m))])


def disc(size_m: Vec3) -> Body:
    """Slices, patties, biscuits, lids: flat and round, and flat on top."""
    (_, _, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    body = Body(parts=[prism((0.0, 0.0), (x1, y1), (z0, z1))])
    body.add_support("top", (-0.7 * x1, -0.7 * y1), (0.7 * x1, 0.7 * y1), z1)
    return body


def soft(size_m: Vec3) -> Body:
    """Pillows, filled bags, shoes: a box with cut edges."""
    if size_m[2] < 0.02:
        (low, high) = (centred(size_m).low_m, centred(size_m).high_m)
        return Body(parts=[box(low, high)])
    return Body(parts=[cushion(centred(size_m))])


def utensil(size_m: Vec3) -> Body:
    """A handle and a broader head along the longest side, both lying flat."""
    outer = centred(size_m)
    (x0, y0, z0), (x1, y1, z1) = outer.low_m, outer.high_m
    axis = max(range(3), key=lambda i: size_m[i])
    if axis == 2 or min(size_m) < 0.006:  # one that stands has the whole base to stand on
        return Body(parts=[box(outer.low_m, outer.high_m)])
    grip = 0.3
    top = z0 + 0.6 * (z1 - z0)
    if axis == 0:
        cut = x1 - 0.35 * size_m[0]
        parts = [box((cut, y0, z0), (x1, y1, z1)), box((x0, grip * y0, z0), (cut, grip * y1, top))]
    else:
        cut = y1 - 0.35 * size_m[1]
        parts = [box((x0, cut, z0), (x1, y1, z1)), box((grip * x0, y0, z0), (grip * x1, cut, top))]
    return Body(parts=parts)
