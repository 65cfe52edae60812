"""Small loose things: food, cutlery, soft goods. All have a flat base, so that they rest where they are put."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.factory.assets.body import Body, centred
from embomatrix.factory.assets.shapes import (
    box,
    box_of,
    capsule,
    cushion,
    dome,
    frustum,
    half_disc,
    loaf,
    log,
    lump,
    prism,
    ridge,
    ring,
    wedge,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.world.geometry import Aabb, ConvexPart, Vec3


LEAST_ROUND_M: Final = 0.01
"""What is thinner is a plain box: an engine's margins are of that order, and a box rests most quietly."""
_LONG: Final = 2.2
"""What is longer than this many of its widths is a bar, not a ball."""


def round_food(size_m: Vec3) -> Body:
    """Fruit, vegetables, roasts: an ellipsoid with a dent to rest on; flat ones are discs, long ones capsules."""
    if size_m[2] < 0.35 * min(size_m[:2]):
        return disc(size_m)
    if max(size_m[:2]) > _LONG * min(size_m[:2]):
        return _of(capsule, size_m)
    return Body(parts=[lump(centred(size_m))])


def half_food(size_m: Vec3) -> Body:
    """A half on its cut face; of a flat round, half a disc."""
    if size_m[2] < 0.25 * max(size_m[:2]):
        return _of(half_disc, size_m)
    return Body(parts=[dome(centred(size_m))])


def bread(size_m: Vec3) -> Body:
    """Bread and pastry with an arched back."""
    return _of(loaf, size_m)


def slice_of_cake(size_m: Vec3) -> Body:
    """A wedge: slices of cake, pie and melon."""
    return _of(wedge, size_m)


def cloth(size_m: Vec3) -> Body:
    """A thing of cloth, folded: a low block that narrows upwards, on which others can be stacked."""
    outer = centred(size_m)
    share = 0.84
    thick = min(size_m) >= LEAST_ROUND_M
    body = Body(parts=[frustum(outer, share) if thick else box(outer.low_m, outer.high_m)])
    (x0, y0, _), (x1, y1, z1) = outer.low_m, outer.high_m
    body.add_support("top", (share * x0, share * y0), (share * x1, share * y1), z1)
    return body


def bar(size_m: Vec3) -> Body:
    """A round bar that lies: logs, rolled things, torches."""
    return _of(log, size_m)


def heap(size_m: Vec3) -> Body:
    """Boulders, bushes, heaps: broad at the foot."""
    return _of(dome, size_m)


def tent(size_m: Vec3) -> Body:
    """A ridge between two slopes."""
    return _of(ridge, size_m)


def hoop(size_m: Vec3) -> Body:
    """A ring that lies flat: wreaths, tyres, coils of hose."""
    (_, _, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    if min(size_m) < LEAST_ROUND_M or size_m[2] > 0.8 * min(size_m[:2]):
        return _of(box_of, size_m)
    return Body(parts=ring((0.0, 0.0), (x1, y1), (z0, z1), 0.22 * min(size_m[:2])))


def figure(size_m: Vec3) -> Body:
    """A base with a trunk and a head on it: statues, dolls, toy figures."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    foot, neck = z0 + 0.12 * size_m[2], z0 + 0.72 * size_m[2]
    return Body(
        parts=[
            box((x0, y0, z0), (x1, y1, foot)),
            box((0.7 * x0, 0.7 * y0, foot), (0.7 * x1, 0.7 * y1, neck)),
            box((0.42 * x0, 0.42 * y0, neck), (0.42 * x1, 0.42 * y1, z1)),
        ]
    )


def dumbbell(size_m: Vec3) -> Body:
    """Two heads with a grip between them."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    ends = [
        box((x0, y0, z0), (x1, y0 + 0.3 * size_m[1], z1)),
        box((x0, y1 - 0.3 * size_m[1], z0), (x1, y1, z1)),
        box((0.3 * x0, 0.4 * y0, 0.3 * z0), (0.3 * x1, 0.4 * y1, 0.3 * z1)),
    ]
    return Body(parts=ends)


def _of(shape: Callable[[Aabb], ConvexPart], size_m: Vec3) -> Body:
    """One convex piece that fills the box, or the box itself where that is thin."""
    outer = centred(size_m)
    return Body(parts=[shape(outer) if min(size_m) >= LEAST_ROUND_M else box_of(outer)])


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
