"""Furniture round a corner: sofas, benches, bars and worktops in the shape of an L.

The catalog gives a model's box only. No seat is as deep as a corner model is on both sides, so its true outline is two arms
with open floor between them. Seats and worktops have their arms at the back and on the right: they stand in a corner of a
room. A bar has its long arm at the front, where the guests sit, and the nook behind it.
"""

from collections.abc import Mapping
from typing import Final

from embomatrix.factory.assets.body import Body, centred
from embomatrix.factory.assets.furniture import legs, seat_height
from embomatrix.factory.assets.shapes import box
from embomatrix.world.geometry import Vec3

CORNER_FROM_M: Final = 1.4
"""A model larger than this along both sides stands round a corner."""
ARM_M: Final[Mapping[str, float]] = {"sofa": 0.95, "bench": 0.55, "bar": 0.7, "countertop": 0.65}
"""Depth of both arms, by category."""
_BACK_FROM_M: Final = 0.65
"""Height from which a bench has a back."""


def is_corner(category: str, size_m: Vec3) -> bool:
    """True for a model that stands round a corner."""
    return category in ARM_M and min(size_m[:2]) > CORNER_FROM_M


def corner_sofa(size_m: Vec3) -> Body:
    """Seats along the back and along the right side with a back rest behind each; open floor between them."""
    return _seats(size_m, ARM_M["sofa"], 0.22)


def corner_bench(size_m: Vec3) -> Body:
    """Benches along the back and along the right side; low ones have no back rest."""
    deep = ARM_M["bench"]
    if size_m[2] >= _BACK_FROM_M:
        return _seats(size_m, deep, 0.06)
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    body = Body([box((x0, y0, z0), (x0 + deep, y1, z1)), box((x0 + deep, y0, z0), (x1, y0 + deep, z1))])
    body.add_support("seat", (x0, y0), (x0 + deep, y1), z1)
    return body.add_support("long_seat", (x0 + deep, y0), (x1, y0 + deep), z1)


def corner_bar(size_m: Vec3) -> Body:
    """A counter along the front and along the right side; the host stands in the nook behind it."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    deep, top, inset = ARM_M["bar"], 0.04, 0.08
    body = Body(
        [
            box((x1 - deep, y0, z1 - top), (x1, y1, z1)),
            box((x0, y0, z1 - top), (x1 - deep, y0 + deep, z1)),
            box((x1 - deep, y0 + inset, z0), (x1 - inset, y1, z1 - top)),
            box((x0, y0 + inset, z0), (x1 - deep, y0 + deep, z1 - top)),
        ]
    )
    body.add_support("top", (x1 - deep, y0), (x1, y1), z1)
    return body.add_support("side_top", (x0, y0), (x1 - deep, y0 + deep), z1)


def corner_worktop(size_m: Vec3) -> Body:
    """A board along the back and one along the right side."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    deep = ARM_M["countertop"]
    body = Body([box((x0, y0, z0), (x0 + deep, y1, z1)), box((x0 + deep, y0, z0), (x1, y0 + deep, z1))])
    body.add_support("top", (x0, y0), (x0 + deep, y1), z1)
    return body.add_support("side_top", (x0 + deep, y0), (x1, y0 + deep), z1)


def _seats(size_m: Vec3, deep: float, back: float) -> Body:
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    z, feet = z0 + seat_height(size_m[2]), 0.1 * size_m[2]
    parts = [
        box((x0, y0, z0 + feet), (x0 + deep, y1, z)),
        box((x0 + deep, y0, z0 + feet), (x1, y0 + deep, z)),
        box((x0, y0, z), (x0 + back, y1, z1)),
        box((x0 + back, y0, z), (x1, y0 + back, z1)),
        *legs((x0, y0), (x0 + deep, y1), (z0, z0 + feet), 0.08),
        box((x1 - 0.08, y0, z0), (x1, y0 + 0.08, z0 + feet)),
        box((x1 - 0.08, y0 + deep - 0.08, z0), (x1, y0 + deep, z0 + feet)),
    ]
    body = Body(parts).add_support("seat", (x0 + back, y0 + back), (x0 + deep, y1), z)
    return body.add_support("long_seat", (x0 + deep, y0 + back), (x1, y0 + deep), z)
