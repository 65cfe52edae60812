"""Fixtures of a building: sinks, baths, toilets, stoves, doors, windows, screens, plants, cars."""

from typing import Final

from embomatrix.factory.assets.body import (
    FIT_M,
    FULL,
    OPEN_ABOVE_M,
    Body,
    Hinge,
    Walls,
    centred,
    clamp,
    hinged,
    proportioned,
    region,
    shell,
    sliding,
    spanning,
)
from embomatrix.factory.assets.furniture import legs, slab
from embomatrix.factory.assets.shapes import box, box_of, lump, octagon
from embomatrix.world.geometry import Aabb, ConvexPart, Vec2, Vec3

_ON_LEGS_M: Final = 0.6
"""Height from which a grill stands on legs."""
_TAP_M: Final = 0.2
_BASIN_DEPTH_M: Final = 0.18


def furniture_sink(size_m: Vec3) -> Body:
    """A base cabinet with a basin in its top, worktop on both sides, and a tap behind."""
    return _sink(size_m, basins=1, basin_width_m=0.6)


def multi_sink(size_m: Vec3) -> Body:
    """A row of basins."""
    return _sink(size_m, basins=int(clamp(round(size_m[1] / 0.8), 1, 3)), basin_width_m=0.5)


def _sink(size_m: Vec3, basins: int, basin_width_m: float) -> Body:
    """A block from the floor to the worktop with basins let in; the worktop carries objects."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    deck = z1 - min(_TAP_M, 0.3 * size_m[2])
    depth = min(_BASIN_DEPTH_M, 0.6 * (deck - z0))
    back, front = x0 + 0.2 * size_m[0], x1 - 0.08 * size_m[0]
    pitch = size_m[1] / basins
    half = min(basin_width_m, 0.8 * pitch) / 2
    body = Body(
        [
            box((x0, y0, z0), (x1, y1, deck - depth)),
            box((x0, y0, deck - depth), (back, y1, deck)),
            box((front, y0, deck - depth), (x1, y1, deck)),
        ]
    )
    centres = [y0 + (k + 0.5) * pitch for k in range(basins)]
    edges = [y0, *(y for centre in centres for y in (centre - half, centre + half)), y1]
    for number, (low, high) in enumerate(zip(edges[::2], edges[1::2], strict=True), start=1):
        body.parts.append(box((back, low, deck - depth), (front, high, deck)))
        body.add_support(f"worktop{number}", (x0 if number == 1 else back, low), (x1, high), deck)
    for number, y in enumerate(centres, start=1):
        name = "basin" if basins == 1 else f"basin{number}"
        cavity = region((back, front), (y - half, y + half), (deck - depth, deck))
        body.add_interior(name, cavity, clearance_m=_under_tap((deck, z1)) - cavity.low_m[2])
        body.parts.extend(_tap((x0 + 0.06 * size_m[0], y), back + 0.35 * (front - back), (deck, z1)))
    return body


def _tap(foot: Vec2, reach: float, z: Vec2) -> list[ConvexPart]:
    """A post behind the basin and a spout over it."""
    x, y = foot
    r = _tap_radius(z)
    return [
        box((x - r, y - r, z[0]), (x + r, y + r, z[1])),
        box((x + r, y - r, _under_tap(z)), (reach, y + r, z[1])),
    ]


def _tap_radius(z: Vec2) -> float:
    return clamp(0.08 * (z[1] - z[0]), 0.006, 0.015)


def _under_tap(z: Vec2) -> float:
    """Return the height of the spout's underside."""
    return z[1] - 2 * _tap_radius(z)


def pedestal_sink(size_m: Vec3) -> Body:
    """A single basin on a column; on a bracket if it hangs on a wall."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    deck = z1 - min(_TAP_M, 0.3 * size_m[2])
    depth = min(_BASIN_DEPTH_M, 0.5 * (deck - z0))
    wall = clamp(0.07 * min(size_m[:2]), 0.02, 0.05)
    bowl = Aabb((x0, y0, deck - depth), (x1, y1, deck))
    parts, cavity = shell(bowl, Walls(0.22 * size_m[0], wall, wall, wall, 0.03, 0.0))
    parts.append(box((x0, -0.12 * size_m[1], z0), (x0 + 0.65 * size_m[0], 0.12 * size_m[1], deck - depth)))
    parts += _tap((x0 + 0.1 * size_m[0], 0.0), cavity.center_m[0], (deck, z1))
    clearance_m = _under_tap((deck, z1)) - cavity.low_m[2]
    body = Body(parts).add_interior("basin", cavity, clearance_m=clearance_m)
    edge, tap = x0 + 0.22 * size_m[0], 2 * _tap_radius((deck, z1))
    body.add_support("right_rim", (x0, y0), (edge, -tap), deck)
    return body.add_support("left_rim", (x0, tap), (edge, y1), deck)


def tub(size_m: Vec3) -> Body:
    """Bath, pool: a block with a deep basin and thick rims."""
    outer = centred(size_m)
    wall = clamp(0.1 * min(size_m[:2]), 0.03, 0.3)
    parts, cavity = shell(outer, Walls(wall, wall, wall, wall, clamp(0.15 * size_m[2], 0.02, 0.2), 0.0))
    body = Body(parts).add_interior("basin", cavity, clearance_m=OPEN_ABOVE_M)
    return body.add_support("rim", outer.low_m[:2], (outer.high_m[0], cavity.low_m[1]), outer.high_m[2])


def toilet(size_m: Vec3) -> Body:
    """Bowl with a closed seat, cistern behind."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    seat = z0 + clamp(0.42, 0.5 * size_m[2], 0.75 * size_m[2])
    tank = x0 + 0.28 * size_m[0]
    body = Body(parts=[box((tank, y0, z0), (x1, y1, seat)), box((x0, y0, z0), (tank, y1, z1))])
    body.add_support("seat", (tank, y0), (x1, y1), seat)
    return body.add_support("cistern", (x0, y0), (tank, y1), z1)


def shower_stall(size_m: Vec3) -> Body:
    """Tray with walls on three sides and an open front."""
    tray = clamp(0.03 * size_m[2], 0.02, 0.08)
    parts, cavity = shell(centred(size_m), Walls(0.04, 0.0, 0.04, 0.04, tray, 0.0))
    return Body(parts).add_support("tray", cavity.low_m[:2], cavity.high_m[:2], cavity.low_m[2])


def cooktop(size_m: Vec3) -> Body:
    """A stove, grill plate or burner: a block whose whole top is the hot surface."""
    return slab(size_m, "cooktop")


def grill(size_m: Vec3) -> Body:
    """A fire box on four legs, whose whole top is the hot surface; a low one stands on the ground."""
    if size_m[2] < _ON_LEGS_M:
        return cooktop(size_m)
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    fire = z1 - 0.4 * size_m[2]
    thick = clamp(0.08 * min(size_m[:2]), 0.02, 0.06)
    body = Body(parts=[box((x0, y0, fire), (x1, y1, z1)), *legs((x0, y0), (x1, y1), (z0, fire), thick)])
    return body.add_support("cooktop", (x0, y0), (x1, y1), z1)


_COFFEE_MACHINE: Final = (
    ((-1.0, -0.2), FULL, (-0.84, 1.0)),
    (FULL, FULL, (-1.0, -0.84)),
    ((-0.2, 1.0), FULL, (0.4, 1.0)),
)


def coffee_machine(size_m: Vec3) -> Body:
    """A back with a head, over a tray for cups."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    foot, head, back = z0 + 0.08 * size_m[2], z1 - 0.3 * size_m[2], x0 + 0.4 * size_m[0]
    body = Body(parts=proportioned(size_m, _COFFEE_MACHINE))
    body.add_interior("bay", region((back, x1), (y0, y1), (foot, head)))
    return body.add_support("top", (x0, y0), (x1, y1), z1)


def door(size_m: Vec3) -> Body:
    """A frame of two posts and a lintel, and a panel that turns about its right edge."""
    body, gap = _frame(centred(size_m))
    body.moving.append(hinged("leaf", _fitted(gap, min(0.05, 0.5 * size_m[0])), Hinge.RIGHT))
    return body


def sliding_door(size_m: Vec3) -> Body:
    """A frame with a fixed pane in its right half and a pane in its left half that slides in front of it."""
    body, gap = _frame(centred(size_m))
    (x0, y0, z0), (x1, y1, z1) = gap.low_m, gap.high_m
    third = (x1 - x0) / 3
    body.parts.append(box((x0, y0, z0), (x0 + third, 0.0, z1)))
    pane = Aabb((x1 - third, FIT_M, z0 + FIT_M), (x1, y1 - FIT_M, z1 - FIT_M))
    body.moving.append(sliding("pane", pane, (0.0, -1.0, 0.0), y1 - 2 * FIT_M))
    return body


def garage_door(size_m: Vec3) -> Body:
    """A frame with a panel in front of it that slides up."""
    outer = centred(size_m)
    panel_m = min(0.06, 0.4 * size_m[0])
    x1 = outer.high_m[0]
    body, gap = _frame(Aabb(outer.low_m, (x1 - panel_m, *outer.high_m[1:])))
    panel = Aabb((x1 - panel_m + FIT_M, outer.low_m[1], outer.low_m[2] + FIT_M), outer.high_m)
    body.moving.append(sliding("leaf", panel, (0.0, 0.0, 1.0), 0.9 * gap.size_m[2]))
    return body


def window(size_m: Vec3) -> Body:
    """A frame and sill with a sash that opens to the front."""
    body, gap = _frame(centred(size_m), sill_m=clamp(0.05 * size_m[2], 0.02, 0.1))
    body.moving.append(hinged("sash", _fitted(gap, min(0.04, 0.5 * size_m[0])), Hinge.RIGHT))
    return body


def _fitted(gap: Aabb, depth_m: float) -> Aabb:
    """Return the box of a panel at the front of an opening, with a gap to the frame on all sides."""
    (_, y0, z0), (x1, y1, z1) = gap.low_m, gap.high_m
    return Aabb((x1 - depth_m, y0 + FIT_M, z0 + FIT_M), (x1, y1 - FIT_M, z1 - FIT_M))


def _frame(outer: Aabb, sill_m: float = 0.0) -> tuple[Body, Aabb]:
    """Return two posts, a lintel and, if ``sill_m`` is above 0, a sill; and the opening between them."""
    post = clamp(0.05 * outer.size_m[1], 0.02, 0.1)
    parts, gap = shell(outer, Walls(0.0, 0.0, post, post, sill_m, post))
    return Body(parts=parts), gap


def laptop(size_m: Vec3) -> Body:
    """A keyboard with a screen that folds up."""
    outer = centred(size_m)
    z = outer.low_m[2] + 0.55 * size_m[2]
    lid = spanning(outer, 2, (z + 0.05 * size_m[2], outer.high_m[2]))
    return Body([box_of(spanning(outer, 2, (outer.low_m[2], z)))], [hinged("screen", lid, Hinge.BACK)])


def screen(size_m: Vec3) -> Body:
    """A panel on a foot: televisions, monitors."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    panel, foot, neck = 0.25 * size_m[0], 0.03 * size_m[2], 0.15 * size_m[2]
    return Body(
        parts=[
            box((x0, 0.6 * y0, z0), (x1, 0.6 * y1, z0 + foot)),
            box((-0.5 * panel, 0.1 * y0, z0 + foot), (0.5 * panel, 0.1 * y1, z0 + neck)),
            box((-0.5 * panel, y0, z0 + neck), (0.5 * panel, y1, z1)),
        ]
    )


def mirror(size_m: Vec3) -> Body:
    """A pane of glass in a frame on the wall."""
    outer = centred(size_m)
    frame = clamp(0.05 * min(size_m[1:]), 0.015, 0.05)
    boards, gap = shell(outer, Walls(0.0, 0.0, frame, frame, frame, frame))
    pane = spanning(gap, 0, (gap.low_m[0], gap.low_m[0] + 0.6 * size_m[0]))
    return Body([box_of(pane), *boards])


def plant(size_m: Vec3) -> Body:
    """A pot with a crown of leaves."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    rim = z0 + 0.3 * size_m[2]
    return Body(
        parts=[
            *octagon((0.0, 0.0), (0.6 * x1, 0.6 * y1), (z0, rim)),
            lump(Aabb((x0, y0, rim), (x1, y1, z1))),
        ]
    )


def tree(size_m: Vec3) -> Body:
    """A trunk and a crown."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    trunk, r = z0 + 0.35 * size_m[2], clamp(0.05 * min(size_m[:2]), 0.01, 0.2)
    return Body(parts=[box((-r, -r, z0), (r, r, trunk)), lump(Aabb((x0, y0, trunk), (x1, y1, z1)))])


def car(size_m: Vec3) -> Body:
    """Bonnet and cabin as blocks, and a boot with a lid that is hinged at the cabin.

    The boot is at +x, like the doors of furniture: furnishing keeps that side free and puts the bonnet to the wall.
    """
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    waist, boot = z0 + 0.62 * size_m[2], x1 - 0.22 * size_m[0]
    lid = 0.04
    parts, cavity = shell(
        Aabb((boot, y0, z0 + 0.12 * size_m[2]), (x1, y1, waist - lid)), Walls(0.1, 0.1, 0.1, 0.1, 0.15, 0.0)
    )
    parts.append(box((x0, y0, z0), (boot, y1, waist)))
    parts.append(box((x1 - 0.7 * size_m[0], 0.9 * y0, waist), (boot, 0.9 * y1, z1)))
    panel = Aabb((boot + FIT_M, y0, waist - lid + FIT_M), (x1, y1, waist))
    return Body(parts, [hinged("boot_lid", panel, Hinge.BACK)]).add_interior("boot", cavity, ("boot_lid",))
