"""Small loose objects: food, cutlery, soft goods. All have a flat base, so they do not roll away."""

from collections.abc import Callable
from typing import Final

from embomatrix.factory.assets.body import FULL, Body, centred
from embomatrix.factory.assets.shapes import (
    box,
    box_of,
    capsule,
    cushion,
    dome,
    frustum,
    half_disc,
    lump,
    prism,
    ring,
)
from embomatrix.world.geometry import Aabb, ConvexPart, Vec3

LEAST_ROUND_M: Final = 0.01
"""Thinner objects become plain boxes: the engine's collision margin is of this order, and a box comes to rest fastest."""
_LONG: Final = 2.2
"""Ratio of length to width from which a fruit is a bar instead of a ball."""


def round_food(size_m: Vec3) -> Body:
    """Fruit, vegetables, roasts: an ellipsoid with a dent to rest on; flat ones are discs, long ones capsules."""
    if size_m[2] < 0.35 * min(size_m[:2]):
        return disc(size_m)
    if max(size_m[:2]) > _LONG * min(size_m[:2]):
        return filled(size_m, capsule)
    return Body(parts=[lump(centred(size_m))])


def half_food(size_m: Vec3) -> Body:
    """A half that lies on its cut face; half a disc if the whole is flat."""
    if size_m[2] < 0.25 * max(size_m[:2]):
        return filled(size_m, half_disc)
    return Body(parts=[dome(centred(size_m))])


def cloth(size_m: Vec3) -> Body:
    """Folded cloth: a low block that narrows upwards and carries other objects."""
    outer = centred(size_m)
    share = 0.84
    thick = min(size_m) >= LEAST_ROUND_M
    body = Body([frustum(outer, share) if thick else box_of(outer)])
    (x0, y0, _), (x1, y1, z1) = outer.low_m, outer.high_m
    return body.add_support("top", (share * x0, share * y0), (share * x1, share * y1), z1)


def hoop(size_m: Vec3) -> Body:
    """A ring that lies flat: wreaths, tyres, coils of hose."""
    (_, _, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    if min(size_m) < LEAST_ROUND_M or size_m[2] > 0.8 * min(size_m[:2]):
        return filled(size_m, box_of)
    return Body(parts=ring((0.0, 0.0), (x1, y1), (z0, z1), 0.22 * min(size_m[:2])))


FIGURE: Final = (
    (FULL, FULL, (-1.0, -0.76)),
    ((-0.7, 0.7), (-0.7, 0.7), (-0.76, 0.44)),
    ((-0.42, 0.42), (-0.42, 0.42), (0.44, 1.0)),
)
"""A base with a trunk and a head on it: statues, dolls, toy figures."""
DUMBBELL: Final = (
    (FULL, (-1.0, -0.4), FULL),
    (FULL, (0.4, 1.0), FULL),
    ((-0.3, 0.3), (-0.4, 0.4), (-0.3, 0.3)),
)
"""Two heads with a grip between them."""


def filled(size_m: Vec3, shape: Callable[[Aabb], ConvexPart]) -> Body:
    """One convex part that fills the box; the box itself if it is thin."""
    outer = centred(size_m)
    return Body(parts=[shape(outer) if min(size_m) >= LEAST_ROUND_M else box_of(outer)])


def disc(size_m: Vec3) -> Body:
    """Slices, patties, biscuits, lids: flat and round, and flat on top."""
    (_, _, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    body = Body([prism((0.0, 0.0), (x1, y1), (z0, z1))])
    return body.add_support("top", (-0.7 * x1, -0.7 * y1), (0.7 * x1, 0.7 * y1), z1)


def soft(size_m: Vec3) -> Body:
    """Pillows, filled bags, shoes: a box with cut edges."""
    outer = centred(size_m)
    return Body(parts=[box_of(outer) if size_m[2] < 0.02 else cushion(outer)])


def utensil(size_m: Vec3) -> Body:
    """A handle and a broader head along the longest side, both lying flat."""
    outer = centred(size_m)
    (x0, y0, z0), (x1, y1, z1) = outer.low_m, outer.high_m
    axis = max(range(3), key=lambda i: size_m[i])
    if axis == 2 or min(size_m) < 0.006:  # an upright utensil needs its whole base to stand
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
