"""Groups of a room: counters, seating, table sets, and the order in which they are placed."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

from embomatrix.factory.assets.corners import ARM_M, is_corner
from embomatrix.factory.furnish.halls import hall_groups, planting_groups
from embomatrix.factory.furnish.hung import on_wall
from embomatrix.factory.furnish.kitchen import COOKERS, SINKS, basin, run_groups, worktop
from embomatrix.factory.furnish.pieces import (
    FurnitureGroup,
    FurniturePiece,
    Member,
    Pool,
    Rows,
    Style,
    around_table,
    stacked,
    top_of,
    worth,
)
from embomatrix.factory.furnish.roles import FurnitureRole
from embomatrix.factory.furnish.tables import table_groups, work_groups
from embomatrix.world.scene import Room

_COFFEE_GAP_M: Final = 0.38
_PAIR: Final = 2
_TV_STANDS: Final = ("console_table", "bottom_cabinet", "bookcase", "coffee_table", "breakfast_table")
_CLEAR_M: Final = 0.8
"""Free floor on all sides of furniture in the middle of a room."""
_ISLANDS: Final = ("commercial_kitchen_table", "display_case", "bar")
_LONG_SIDE: Final = ("bathtub", "bicycle")
_ISLAND_M: Final = 2.0
"""Kitchen tables longer than this stand in the middle of the kitchen."""
_IN_LINE: Final = 3
"""Number of equal pieces from which they stand side by side: lockers, toilets, shelves."""
_NEAR: Final[Mapping[str, tuple[str, ...]]] = {
    "armchair": ("coffee_table", "sofa"),
    "ottoman": ("sofa", "armchair"),
    "floor_lamp": ("sofa", "armchair", "bed"),
    "standing_loudspeaker": ("standing_tv", "sofa"),
    "public_trash_can": SINKS,
    "trash_can": SINKS,
    "hamper": ("desk", "cubicle"),
    "shredder": ("desk", "conference_table"),
    "desktop_computer": ("desk", "conference_table"),
    "radiator": ("window",),
    "nightstand": ("bed",),
    "serving_cart": COOKERS,
    "coatrack": ("doorway",),
    "hall_tree": ("doorway",),
    "umbrella_rack": ("doorway",),
    "checkout_counter": ("doorway",),
    "reception_desk": ("doorway",),
    "shopping_cart": ("doorway",),
    "turnstile": ("doorway",),
    "cash_register": ("checkout_counter", "reception_desk"),
}
_OFF_FLOOR: Final = frozenset(
    (
        FurnitureRole.WALL,
        FurnitureRole.CEILING,
        FurnitureRole.RUG,
        FurnitureRole.HUNG_CABINET,
        FurnitureRole.SURFACE,
        FurnitureRole.STRUCTURE,
    )
)


def room_groups(
    pieces: Sequence[FurniturePiece], room: Room
) -> tuple[list[FurnitureGroup | Rows], list[tuple[FurniturePiece, str]]]:
    """Return the groups of everything on the floor, important ones first, and the pieces that no group takes, with reasons."""
    pool = Pool((p for p in pieces if p.role not in _OFF_FLOOR), room.type, room.size_m)
    left_out: list[tuple[FurniturePiece, str]] = []
    screens = [p for p in pieces if p.category == "wall_mounted_tv"]
    found: list[FurnitureGroup | Rows] = [
        *_television(pool, [p for p in pieces if p.category == "standing_tv"]),
        *(_first(on_wall(p, room.height_m)) for p in screens[:1] if pool.of("sofa")),
        *hall_groups(pool),
        *work_groups(pool),
        *run_groups(pool, left_out),
        *table_groups(pool),
        *_beds(pool),
        *_sofas(pool),
        *planting_groups(pool),
        *_singles(pool),
    ]
    found.sort(key=lambda g: (-g.importance, -_area(g)))
    return found, left_out


def alone(piece: FurniturePiece) -> FurnitureGroup:
    """Return a group of one piece for which its own group had no place: at a wall, on side panels, or hung at its height."""
    if piece.role is FurnitureRole.COUNTERTOP:
        return worktop(piece)
    if piece.role is FurnitureRole.FITTED:
        return basin(piece)
    return FurnitureGroup(
        (_sideways(piece),), Style.ALONG, worth([Member(piece)]), _NEAR.get(piece.category, ())
    )


def in_the_open(piece: FurniturePiece) -> FurnitureGroup | None:
    """Return a group in the middle of the room for a piece that found no wall; None if it must stand at one."""
    if (
        piece.role in (FurnitureRole.TABLE, FurnitureRole.LOW_TABLE, FurnitureRole.OPEN)
        or piece.category in _ISLANDS
    ):
        return FurnitureGroup((Member(piece),), Style.FREE, worth([Member(piece)]), clear_m=_CLEAR_M)
    return None


def _sideways(piece: FurniturePiece) -> Member:
    """Return the piece as a member, turned by a quarter if its long side belongs to the wall: bathtubs, bicycles."""
    return Member(piece, turns=1 if piece.category in _LONG_SIDE and piece.size_m[0] > piece.size_m[1] else 0)


def _first(group: FurnitureGroup) -> FurnitureGroup:
    """Return the group of a screen with an importance above the sofa's: the sofa is then placed to face it."""
    return replace(group, style=Style.CENTERED, importance=9.6)


def _area(group: FurnitureGroup | Rows) -> float:
    if isinstance(group, Rows):
        return sum(_area(g) for g in group.groups)
    x0, y0, x1, y1 = group.bounds
    return (x1 - x0) * (y1 - y0)


def _television(pool: Pool, screens: Sequence[FurniturePiece]) -> list[FurnitureGroup]:
    groups = []
    for tv in screens:
        stands = [
            p
            for p in pool.of(*_TV_STANDS)
            if top_of(p) <= 0.75 and p.size_m[0] >= 0.9 * tv.size_m[0] and p.size_m[1] >= 0.7 * tv.size_m[1]
        ]
        if stands:
            base = Member(pool.take([stands[0]])[0])
            members = (base, stacked(base, tv, 0))
            groups.append(FurnitureGroup(members, Style.CENTERED, 9.55, faces=("sofa", "armchair")))
    return groups


def _beds(pool: Pool) -> list[FurnitureGroup]:
    groups = []
    for bed in pool.take(pool.of("bed", "hospital_bed", "crib")):
        members = [Member(bed)]
        stands = [p for p in pool.of("nightstand", "stand") if p.size_m[2] <= 0.75][:2]
        for stand, side in zip(pool.take(stands if bed.category == "bed" else []), (1, -1), strict=False):
            x = (stand.size_m[0] - bed.size_m[0]) / 2
            members.append(Member(stand, x, side * (bed.size_m[1] + stand.size_m[1] + 0.08) / 2))
        style = Style.CENTERED if bed.category == "bed" else Style.ALONG
        groups.append(FurnitureGroup(tuple(members), style, worth(members), spread=(bed.category,)))
    return groups


def _sofas(pool: Pool) -> list[FurnitureGroup]:
    """Return sofas with a coffee table and armchairs at its ends; a corner sofa stands in a corner, its table in the nook."""
    groups = []
    sofas = pool.take(sorted(pool.of("sofa"), key=lambda p: -p.size_m[1]))
    armchairs = pool.of("armchair") if pool.room_type in ("living_room", "lobby", "garden") else []
    each = len(armchairs) // max(1, len(sofas))
    for sofa in sofas:
        members = [Member(sofa)]
        nook = is_corner(sofa.category, sofa.size_m)
        tables = [p for p in pool.of("coffee_table", "garden_coffee_table") if p.size_m[1] <= sofa.size_m[1]]
        for table in pool.take(tables[:1]):
            at = sofa.size_m[0] / 2 + _COFFEE_GAP_M + table.size_m[0] / 2
            if nook and max(table.size_m[:2]) + 0.3 <= min(sofa.size_m[:2]) - ARM_M["sofa"]:
                members.append(Member(table, ARM_M["sofa"] / 2 + 0.1, ARM_M["sofa"] / 2 + 0.1))
                continue
            members.append(Member(table, at))
            mine = pool.take(armchairs[: min(each, 2)])
            armchairs = armchairs[len(mine) :]
            for chair, side in zip(mine, (1, -1), strict=False):
                y = side * (table.size_m[1] / 2 + 0.3 + chair.size_m[0] / 2)
                members.append(
                    Member(chair, max(at, (sofa.size_m[0] + chair.size_m[1]) / 2 + 0.1), y, turns=2 + side)
                )
        style = Style.NOOK if nook else Style.CENTERED
        screens = ("standing_tv", "wall_mounted_tv")
        groups.append(FurnitureGroup(tuple(members), style, worth(members), faces=screens, spread=("sofa",)))
    return groups if sofas else _armchairs(pool, armchairs)


def _armchairs(pool: Pool, armchairs: Sequence[FurniturePiece]) -> list[FurnitureGroup]:
    """Return armchairs that face one another over a coffee table, for rooms without a sofa."""
    tables = pool.of("coffee_table", "garden_coffee_table")
    if len(armchairs) < _PAIR or not tables:
        return []
    members = around_table(tables[0], armchairs[:_PAIR], _COFFEE_GAP_M)
    pool.take(m.piece for m in members)
    return [FurnitureGroup(members, Style.FREE, worth(members), clear_m=_CLEAR_M / 2)]


def _singles(pool: Pool) -> list[FurnitureGroup]:
    counts = Counter(p.category for p in pool.rest)
    groups = []
    for piece in pool.take(list(pool.rest)):
        style = Style.CORNER if piece.role is FurnitureRole.CORNER else Style.ALONG
        if piece.category == "commercial_kitchen_table" and piece.size_m[1] > _ISLAND_M:
            style = Style.FREE
        near = _NEAR.get(piece.category, ())
        if near:
            style = Style.ALONG
        if (
            not near
            and counts[piece.category] >= _IN_LINE
            and piece.role in (FurnitureRole.BACKED, FurnitureRole.RUN)
        ):
            near = (piece.category,)
        if is_corner(piece.category, piece.size_m) and piece.category == "bench":
            style = Style.NOOK
        if pool.room_type == "locker_room" and piece.category == "bench":
            style = Style.FREE
        clear = _CLEAR_M if style is Style.FREE else 0.0
        groups.append(FurnitureGroup((_sideways(piece),), style, worth([Member(piece)]), near, clear_m=clear))
    return groups
