"""Tables, desks, seats, beds and lamps: boards on legs with free space below."""

from typing import Final

from embomatrix.factory.assets.body import Body, Walls, centred, clamp, raised, region, shell
from embomatrix.factory.assets.drawers import add_drawers
from embomatrix.factory.assets.shapes import box, box_of, octagon
from embomatrix.world.geometry import ConvexPart, Vec2, Vec3


def legs(low: Vec2, high: Vec2, z: Vec2, thickness_m: float) -> list[ConvexPart]:
    """Return four square legs at the corners of a rectangle."""
    (x0, y0), (x1, y1), t = low, high, thickness_m
    return [box((x, y, z[0]), (x + t, y + t, z[1])) for x in (x0, x1 - t) for y in (y0, y1 - t)]


def top_thickness(size_m: Vec3) -> float:
    """Return the thickness of a table's top in metres."""
    return clamp(0.05 * size_m[2], 0.006, 0.04)


def leg_thickness(size_m: Vec3) -> float:
    """Return the width of a table's square legs in metres."""
    return clamp(0.07 * min(size_m[:2]), 0.008, 0.07)


def table(size_m: Vec3, surface: str = "top") -> Body:
    """A top, named ``surface``, on four legs."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    top, leg = top_thickness(size_m), leg_thickness(size_m)
    parts = [box((x0, y0, z1 - top), (x1, y1, z1)), *legs((x0, y0), (x1, y1), (z0, z1 - top), leg)]
    return Body(parts).add_support(surface, (x0, y0), (x1, y1), z1)


def table_with_shelf(size_m: Vec3) -> Body:
    """A table whose legs carry a second board near the floor: kitchen work tables, carts, consoles."""
    body = table(size_m)
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    board = clamp(0.03 * size_m[2], 0.006, 0.025)
    z = z0 + 0.25 * size_m[2]
    body.parts.append(box((x0, y0, z - board), (x1, y1, z)))
    inset, under_top = leg_thickness(size_m), z1 - top_thickness(size_m)
    return body.add_support("shelf", (x0 + inset, y0 + inset), (x1 - inset, y1 - inset), z, under_top - z)


def pedestal_table(size_m: Vec3) -> Body:
    """A round or oval top on a column with a broad foot."""
    (_, _, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    top, foot = clamp(0.05 * size_m[2], 0.006, 0.04), clamp(0.04 * size_m[2], 0.006, 0.03)
    parts = [
        *octagon((0.0, 0.0), (x1, y1), (z1 - top, z1)),
        box((-0.12 * x1, -0.12 * y1, z0 + foot), (0.12 * x1, 0.12 * y1, z1 - top)),
        *octagon((0.0, 0.0), (0.6 * x1, 0.6 * y1), (z0, z0 + foot)),
    ]
    # Inscribed square of the octagon: a larger rectangle would hang over.
    return Body(parts).add_support("top", (-0.7 * x1, -0.7 * y1), (0.7 * x1, 0.7 * y1), z1)


def counter(size_m: Vec3) -> Body:
    """A closed block with a working top: bars, desks of a reception, display cases."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    top = clamp(0.05 * size_m[2], 0.006, 0.05)
    overhang = 0.06 * size_m[0]
    parts = [box((x0, y0, z0), (x1 - overhang, y1, z1 - top)), box((x0, y0, z1 - top), (x1, y1, z1))]
    return Body(parts).add_support("top", (x0, y0), (x1, y1), z1)


def slab(size_m: Vec3, surface: str = "top") -> Body:
    """A solid board or block with a flat top, named ``surface``: worktops, mattresses, books, boards, boxes."""
    outer = centred(size_m)
    return block(size_m).add_support(surface, outer.low_m[:2], outer.high_m[:2], outer.high_m[2])


def block(size_m: Vec3) -> Body:
    """A solid box that carries nothing."""
    return Body([box_of(centred(size_m))])


def seat_height(height_m: float) -> float:
    """Return the height of a seat: 0.42 m, bounded by shares of the whole height for low and high models."""
    return clamp(0.42, 0.35 * height_m, 0.62 * height_m)


def chair(size_m: Vec3) -> Body:
    """Seat on four legs with a back."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    z = z0 + seat_height(size_m[2])
    leg, seat, back = clamp(0.08 * min(size_m[:2]), 0.008, 0.045), 0.04, clamp(0.1 * size_m[0], 0.01, 0.05)
    parts = [
        box((x0, y0, z - seat), (x1, y1, z)),
        box((x0, y0, z), (x0 + back, y1, z1)),
        *legs((x0, y0), (x1, y1), (z0, z - seat), leg),
    ]
    return Body(parts).add_support("seat", (x0 + back, y0), (x1, y1), z)


def swivel_chair(size_m: Vec3) -> Body:
    """Seat and back on a column with a cross of feet."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    z, seat, foot = z0 + seat_height(size_m[2]), 0.06, 0.06
    back, arm = 0.12 * size_m[0], 0.05
    parts = [
        box((x0, y0, z - seat), (x1, y1, z)),
        box((x0, y0, z), (x0 + back, y1, z1)),
        box((-0.04, -0.04, z0 + foot), (0.04, 0.04, z - seat)),
        box((x0, -arm, z0), (x1, arm, z0 + foot)),
        box((-arm, y0, z0), (arm, y1, z0 + foot)),
    ]
    return Body(parts).add_support("seat", (x0 + back, y0), (x1, y1), z)


def stool(size_m: Vec3) -> Body:
    """Seat on four legs without a back: stools, benches, footrests."""
    return table(size_m, "seat")


def sofa(size_m: Vec3) -> Body:
    """Upholstered base on short feet with back and arms."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    z, feet = z0 + seat_height(size_m[2]), 0.1 * size_m[2]
    back = clamp(0.22 * size_m[0], 0.05, 0.3)
    arm = clamp(0.12 * size_m[1], 0.05, 0.2)
    rest = z + 0.4 * (z1 - z)
    parts = [
        box((x0, y0, z0 + feet), (x1, y1, z)),
        box((x0, y0, z), (x0 + back, y1, z1)),
        box((x0 + back, y0, z), (x1, y0 + arm, rest)),
        box((x0 + back, y1 - arm, z), (x1, y1, rest)),
        *legs((x0, y0), (x1, y1), (z0, z0 + feet), clamp(0.08 * min(size_m[:2]), 0.02, 0.08)),
    ]
    return Body(parts).add_support("seat", (x0 + back, y0 + arm), (x1, y1 - arm), z)


def bed(size_m: Vec3) -> Body:
    """Mattress on a frame with legs and a headboard at the back; the foot of the bed is its front."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    z = z0 + clamp(0.55, 0.3 * size_m[2], 0.72 * size_m[2])
    feet = 0.3 * (z - z0)
    head = clamp(0.03 * size_m[0], 0.02, 0.08)
    parts = [
        box((x0 + head, y0, z0 + feet), (x1, y1, z)),
        box((x0, y0, z0), (x0 + head, y1, z1)),
        *legs((x0 + head, y0), (x1, y1), (z0, z0 + feet), clamp(0.06 * min(size_m[:2]), 0.03, 0.1)),
    ]
    return Body(parts).add_support("mattress", (x0 + head, y0), (x1, y1), z)


def bunk_bed(size_m: Vec3) -> Body:
    """Two mattresses between four posts."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    post, thickness = 0.06, 0.18
    lower, upper = z0 + 0.28 * size_m[2], z0 + 0.8 * size_m[2]
    body = Body(legs((x0, y0), (x1, y1), (z0, z1), post))
    for name, z, clearance in (("lower", lower, upper - thickness - lower), ("upper", upper, 2.0)):
        body.parts.append(box((x0 + post, y0, z - thickness), (x1 - post, y1, z)))
        body.add_support(name, (x0 + post, y0), (x1 - post, y1), z, clearance)
    return body


def lamp(size_m: Vec3) -> Body:
    """Foot, pole and shade."""
    (_, _, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    shade, foot = 0.28 * size_m[2], clamp(0.04 * size_m[2], 0.008, 0.05)
    pole = clamp(0.06 * min(size_m[:2]), 0.004, 0.03)
    return Body(
        parts=[
            *octagon((0.0, 0.0), (0.75 * x1, 0.75 * y1), (z0, z0 + foot)),
            box((-pole, -pole, z0 + foot), (pole, pole, z1 - shade)),
            *octagon((0.0, 0.0), (x1, y1), (z1 - shade, z1)),
        ]
    )


PEDESTAL_FROM_M: Final = 1.15
"""Width from which a desk has its drawers in a pedestal: a chair still fits beside it."""
TALL_M: Final = 1.05
"""Height from which a desk has a hutch: its upper part is too high to work at."""
_WORK_M: Final = 0.76
_PANEL_M: Final = 0.018
_BOARD_M: Final = 0.012
_FIT_M: Final = 0.002


def desk(size_m: Vec3) -> Body:
    """A top on four legs; a high model carries a hutch at its back."""
    if size_m[2] <= TALL_M:
        return table(size_m)
    return _with_hutch(table(_below_hutch(size_m)), size_m)


def drawer_desk(size_m: Vec3) -> Body:
    """A desk with drawers in a pedestal at its left; a narrow model has one drawer under its top."""
    if size_m[2] <= TALL_M:
        return _desk_of_drawers(size_m)
    return _with_hutch(_desk_of_drawers(_below_hutch(size_m)), size_m)


def drawer_table(size_m: Vec3) -> Body:
    """A table with a drawer under its top; without the drawer if it is too small."""
    body = table(size_m)
    leg, under = leg_thickness(size_m), size_m[2] / 2 - top_thickness(size_m)
    depth = clamp(0.3 * size_m[2], 0.09, 0.13)
    if min(size_m[:2]) >= 0.25:
        half = size_m[1] / 2 - leg
        _hang(body, size_m, (-half, half), (under - depth, under))
    return body


def _desk_of_drawers(size_m: Vec3) -> Body:
    if size_m[1] < PEDESTAL_FROM_M:
        return drawer_table(size_m)
    body = table(size_m)
    left = size_m[1] / 2 - leg_thickness(size_m)
    width = clamp(0.28 * size_m[1], 0.3, 0.45)
    _hang(body, size_m, (left - width, left), (0.12 - size_m[2] / 2, size_m[2] / 2 - top_thickness(size_m)))
    return body


def _hang(body: Body, size_m: Vec3, y: Vec2, z: Vec2) -> None:
    """Add a carcass of drawers below the top, which closes it above."""
    x = size_m[0] / 2
    carcass = region((-x, x - _PANEL_M), y, z)
    boards, bay = shell(carcass, Walls(_BOARD_M, 0.0, _BOARD_M, _BOARD_M, _BOARD_M, 0.0))
    body.parts += boards
    add_drawers(body, bay, region((x - _PANEL_M + _FIT_M, x), y, (z[0], z[1] - _FIT_M)))


def _below_hutch(size_m: Vec3) -> Vec3:
    return (size_m[0], size_m[1], min(_WORK_M, 0.65 * size_m[2]))


def _with_hutch(lower: Body, size_m: Vec3) -> Body:
    """Add a shelf between two uprights at the back of a desk; the result has the given size."""
    (x0, y0, z0), (_, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    work = _below_hutch(size_m)[2]
    body = raised(lower, (work - size_m[2]) / 2)
    deck, depth, board = z0 + work, 0.4 * size_m[0], 0.02
    body.parts += [
        box((x0, y0, deck), (x0 + depth, y0 + board, z1 - board)),
        box((x0, y1 - board, deck), (x0 + depth, y1, z1 - board)),
        box((x0, y0, z1 - board), (x0 + depth, y1, z1)),
    ]
    body.supports = [surface for surface in body.supports if surface.interior]
    body.add_support("worktop", (x0 + depth, y0), (-x0, y1), deck)
    body.add_support("under_hutch", (x0, y0 + board), (x0 + depth, y1 - board), deck, z1 - board - deck)
    return body.add_support("top", (x0, y0), (x0 + depth, y1), z1)
