"""Open structures and machines: posts, stands, racks, fences, canopies, stairs, gym machines, vehicles, wall fittings."""

from typing import Final

from embomatrix.factory.assets.body import (
    FULL,
    OPEN_ABOVE_M,
    Body,
    Walls,
    centred,
    clamp,
    proportioned,
    shell,
)
from embomatrix.factory.assets.furniture import legs
from embomatrix.factory.assets.shapes import box, octagon
from embomatrix.world.geometry import Aabb, ConvexPart, Vec2, Vec3

COUNTER_M: Final = 0.9
"""Height of a stall's counter."""
RUNG_M: Final = 0.12
"""Distance between the rungs of a rack: an object laid across rests on several of them."""
TIER_M: Final = 0.45
"""Height of a row of seats above the row before it."""
MOST_RUNGS: Final = 10
"""Upper limit for a rack's rungs: a link has at most 16 parts."""


def post(size_m: Vec3) -> Body:
    """A flat foot with a pole: flag poles, tripods, clamps on their stands, signposts."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    foot = z0 + clamp(0.06 * size_m[2], 0.004, 0.05)
    thin = min(size_m[:2])
    thick = clamp(0.08 * thin, min(0.002, 0.4 * thin), 0.04)
    return Body(parts=[box((x0, y0, z0), (x1, y1, foot)), box((-thick, -thick, foot), (thick, thick, z1))])


def pendant(size_m: Vec3) -> Body:
    """A rod with a round shade or blades at its lower end: lamps and fans under a ceiling."""
    (_, _, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    shade = z0 + clamp(0.35 * size_m[2], 0.02, 0.4)
    thick = clamp(0.06 * min(size_m[:2]), 0.003, 0.03)
    return Body(
        parts=[*octagon((0.0, 0.0), (x1, y1), (z0, shade)), box((-thick, -thick, shade), (thick, thick, z1))]
    )


def fence(size_m: Vec3) -> Body:
    """Posts with three rails between them, along the longer side."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    along = 0 if size_m[0] > size_m[1] else 1
    low, high = (x0, y0)[along], (x1, y1)[along]
    count = int(clamp(round((high - low) / 2.0), 1, 6)) + 1
    rail = 0.08 * size_m[2]
    parts = _spaced(size_m, count, min(0.12, 0.2 * (high - low)), (z0, z1))
    inner = (0.4 * x0, 0.4 * y0), (0.4 * x1, 0.4 * y1)  # rails are thinner than posts
    for share in (0.15, 0.5, 0.86):
        foot = z0 + share * size_m[2]
        parts.append(_across(along, (low, high), *inner, (foot, foot + rail)))
    return Body(parts)


def _spaced(size_m: Vec3, count: int, thickness_m: float, z: Vec2) -> list[ConvexPart]:
    """Return bars across the model, evenly spaced along its longer side."""
    (x0, y0, _), (x1, y1, _) = centred(size_m).low_m, centred(size_m).high_m
    along = 0 if size_m[0] > size_m[1] else 1
    low, high = (x0, y0)[along], (x1, y1)[along]
    starts = [low + (high - low - thickness_m) * number / (count - 1) for number in range(count)]
    return [_across(along, (start, start + thickness_m), (x0, y0), (x1, y1), z) for start in starts]


def _across(along: int, span: Vec2, low: Vec2, high: Vec2, z: Vec2) -> ConvexPart:
    """Return a box over ``span`` along one horizontal axis, and from ``low`` to ``high`` along the other."""
    if along == 0:
        return box((span[0], low[1], z[0]), (span[1], high[1], z[1]))
    return box((low[0], span[0], z[0]), (high[0], span[1], z[1]))


def canopy(size_m: Vec3) -> Body:
    """Four posts under a roof: arbours, pergolas, swings, climbing frames."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    roof = roof_thickness(size_m)
    thick = clamp(0.05 * min(size_m[:2]), 0.02, 0.15)
    return Body(
        parts=[box((x0, y0, z1 - roof), (x1, y1, z1)), *legs((x0, y0), (x1, y1), (z0, z1 - roof), thick)]
    )


def stall(size_m: Vec3) -> Body:
    """A counter under a roof on four posts: market stalls, farm stands."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    body = canopy(size_m)
    z = z0 + min(COUNTER_M, 0.5 * size_m[2])
    board = clamp(0.03 * size_m[2], 0.006, 0.04)
    body.parts.append(box((x0, y0, z - board), (x1, y1, z)))
    return body.add_support("counter", (x0, y0), (x1, y1), z, z1 - roof_thickness(size_m) - z)


def rungs(size_m: Vec3) -> Body:
    """Two bars on four posts, with rungs between them along the longer side: bicycle racks."""
    (x0, y0, _), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    thick = bar_thickness(size_m)
    count = int(clamp(round(max(x1 - x0, y1 - y0) / RUNG_M), 2, MOST_RUNGS))
    parts = [*bars(size_m).parts, *_spaced(size_m, count, thick, (z1 - thick, z1))]
    return Body(parts).add_support("rungs", (x0, y0), (x1, y1), z1)


def bar_thickness(size_m: Vec3) -> float:
    """Return the thickness of a rack's bars in metres."""
    return clamp(0.06 * min(size_m[:2]), 0.01, 0.08)


def roof_thickness(size_m: Vec3) -> float:
    """Return the thickness of a canopy's roof in metres."""
    return clamp(0.05 * size_m[2], 0.02, 0.2)


def bars(size_m: Vec3) -> Body:
    """Two bars on four posts: parallel bars, towel stands, luggage racks."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    thick = bar_thickness(size_m)
    rails = [box((x0, y, z1 - thick), (x1, y + thick, z1)) for y in (y0, y1 - thick)]
    return Body(parts=[*rails, *legs((x0, y0), (x1, y1), (z0, z1 - thick), thick)])


def staircase(size_m: Vec3) -> Body:
    """Solid steps that rise towards the back."""
    (x0, y0, z0), (x1, y1, _) = centred(size_m).low_m, centred(size_m).high_m
    steps = int(clamp(round(size_m[2] / 0.18), 2, 16))
    tread, rise = size_m[0] / steps, size_m[2] / steps
    parts = [
        box((x0, y0, z0 + number * rise), (x1 - number * tread, y1, z0 + (number + 1) * rise))
        for number in range(steps)
    ]
    return Body(parts).add_support("step1", (x1 - tread, y0), (x1, y1), z0 + rise)


def tiers(size_m: Vec3) -> Body:
    """Benches that rise towards the back, each with a seat: stands of a gym, benches of a sauna."""
    (x0, y0, z0), (x1, y1, _) = centred(size_m).low_m, centred(size_m).high_m
    rows = int(clamp(round(size_m[2] / TIER_M), 1, 12))
    tread, rise = size_m[0] / rows, size_m[2] / rows
    body = Body([])
    for number in range(rows):
        front, top = x1 - number * tread, z0 + (number + 1) * rise
        body.parts.append(box((x0, y0, top - rise), (front, y1, top)))
        body.add_support(f"tier{number + 1}", (front - tread, y0), (front, y1), top)
    return body


def ladder(size_m: Vec3) -> Body:
    """Two stiles with rungs between them, along the longest side."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    stile = 0.12 * size_m[1]
    body = Body(parts=[box((x0, y0, z0), (x1, y0 + stile, z1)), box((x0, y1 - stile, z0), (x1, y1, z1))])
    axis = 2 if size_m[2] > size_m[0] else 0
    length = size_m[axis]
    for number in range(6):
        middle = -length / 2 + length * (number + 0.5) / 6
        low, high = [0.4 * x0, y0 + stile, 0.4 * z0], [0.4 * x1, y1 - stile, 0.4 * z1]
        low[axis], high[axis] = middle - 0.02 * length, middle + 0.02 * length
        body.parts.append(box(low, high))
    return body


def treadmill(size_m: Vec3) -> Body:
    """A deck with two uprights and a console at its front; exercise bikes and steppers too."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    deck, console = z0 + 0.16 * size_m[2], z1 - 0.15 * size_m[2]
    rear, arm = x1 - 0.12 * size_m[0], 0.1 * size_m[1]
    parts = [
        box((x0, y0, z0), (x1, y1, deck)),
        box((rear, y0, deck), (x1, y0 + arm, console)),
        box((rear, y1 - arm, deck), (x1, y1, console)),
        box((x1 - 0.22 * size_m[0], y0, console), (x1, y1, z1)),
    ]
    return Body(parts).add_support("deck", (x0, y0), (x1 - 0.22 * size_m[0], y1), deck)


def lorry(size_m: Vec3) -> Body:
    """A loading bed and a cab at +x, on wheels: lorries, toy cars and trains."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    deck, axle = z0 + 0.45 * size_m[2], z0 + 0.22 * size_m[2]
    cab = x1 - 0.32 * size_m[0]
    wheel, tyre = 0.16 * size_m[0], 0.2 * size_m[1]
    wheels = [
        box((x, y, z0), (x + wheel, y + tyre, axle))
        for x in (x0 + 0.06 * size_m[0], x1 - 0.06 * size_m[0] - wheel)
        for y in (y0, y1 - tyre)
    ]
    body = Body([box((x0, y0, axle), (x1, y1, deck)), box((cab, y0, deck), (x1, y1, z1)), *wheels])
    return body.add_support("bed", (x0, y0), (cab, y1), deck)


_SLIM: Final = (-0.12, 0.12)
CYCLE: Final = (
    ((-1.0, -0.28), _SLIM, (-1.0, 0.2)),
    ((0.28, 1.0), _SLIM, (-1.0, 0.2)),
    ((-0.28, 0.28), _SLIM, (-0.4, 0.4)),
    ((0.3, 0.5), FULL, (0.8, 1.0)),
    ((0.34, 0.46), _SLIM, (0.2, 0.8)),
    ((-0.08, 0.08), (-0.7, 0.7), (-1.0, -0.88)),
    ((-0.04, 0.04), _SLIM, (-0.88, -0.4)),
)
"""Two wheels, a frame, handlebars with their stem, and a stand."""
RANGE_HOOD: Final = ((FULL, FULL, (-1.0, -0.2)), ((-1.0, 0.2), (-0.4, 0.4), (-0.2, 1.0)))
"""A broad hood with a duct above."""
SHOWER_RAIL: Final = (((-1.0, -0.76), _SLIM, FULL), ((-0.76, 1.0), FULL, (0.84, 1.0)))
"""A rail on the wall with an arm and a shower head at its upper end."""
TELEPHONE: Final = ((FULL, FULL, (-1.0, 0.2)), (FULL, (0.3, 1.0), (0.2, 1.0)))
"""A low case with a handset across its left."""
_MICROSCOPE: Final = (
    (FULL, FULL, (-1.0, -0.7)),
    ((-1.0, -0.3), (-0.4, 0.4), (-0.7, 1.0)),
    ((-0.3, 0.6), (-0.4, 0.4), (0.4, 1.0)),
)
_WHEELED_BOARD: Final = (
    (FULL, FULL, (0.2, 1.0)),
    (FULL, (-0.7, -0.5), (-1.0, 0.2)),
    (FULL, (0.5, 0.7), (-1.0, 0.2)),
)


def urinal(size_m: Vec3) -> Body:
    """A back plate with a bowl before its lower half."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    back, rim = x0 + 0.25 * size_m[0], z0 + 0.5 * size_m[2]
    wall = clamp(0.08 * min(size_m), 0.005, 0.03)
    parts, cavity = shell(Aabb((back, y0, z0), (x1, y1, rim)), Walls(0.0, wall, wall, wall, wall, 0.0))
    body = Body([box((x0, y0, z0), (back, y1, z1)), *parts])
    return body.add_interior("bowl", cavity, clearance_m=OPEN_ABOVE_M)


def workstation(size_m: Vec3) -> Body:
    """Walls on three sides of an open front: cubicles, booths, stalls."""
    wall = clamp(0.04 * min(size_m[:2]), 0.01, 0.06)
    return Body(shell(centred(size_m), Walls(wall, 0.0, wall, wall, 0.0, 0.0))[0])


def microscope(size_m: Vec3) -> Body:
    """A foot, an arm behind and a head that reaches forward."""
    (x0, y0, z0), (x1, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    foot, head, arm = z0 + 0.15 * size_m[2], z1 - 0.3 * size_m[2], x0 + 0.35 * size_m[0]
    body = Body(proportioned(size_m, _MICROSCOPE))
    return body.add_support("stage", (arm, y0), (x1, y1), foot, head - foot)


def wheeled_board(size_m: Vec3) -> Body:
    """A board on two axles: skateboards, scooters."""
    outer = centred(size_m)
    body = Body(proportioned(size_m, _WHEELED_BOARD))
    return body.add_support("deck", outer.low_m[:2], outer.high_m[:2], outer.high_m[2])
