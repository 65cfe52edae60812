"""Groups of tables and seats: dining sets, workplaces, rows that face a board, booths and bars."""

from collections.abc import Sequence
from typing import Final

from embomatrix.factory.furnish.pieces import (
    FurnitureGroup,
    FurniturePiece,
    Member,
    Pool,
    Rows,
    Style,
    around_table,
    before_table,
    seats_around,
    top_of,
    worth,
)
from embomatrix.factory.furnish.roles import FurnitureRole

STOOLS: Final = ("music_stool", "taboret")
_KNEE_M: Final = 0.05
_STOOL_GAP_M: Final = 0.12
_DINING_TOP_M: Final = 0.62
"""Height from which a coffee table serves for eating."""
_HIGH_TABLE_M: Final = 0.85
_EATING: Final = frozenset(
    ("dining_room", "conference_hall", "break_room", "bar", "lobby", "garden", "meeting_room")
)
"""Rooms in which armchairs also serve as seats at tables that lack chairs."""
_FACING: Final = frozenset(("classroom", "computer_lab", "biology_lab", "chemistry_lab", "conference_hall"))
"""Rooms in which all seats face one way."""
_WORK: Final = ("desk", "cubicle")
ROW_OF: Final = 4
"""Number of equal sets from which they stand in rows."""
ALIKE: Final = 1.4
_SET_CLEAR_M: Final = 0.5
_WALK_M: Final = 0.8
_ROW_M: Final = 0.3
"""Free floor behind the chairs of a class, which are reached by the aisle beside them."""
_SEAT_M: Final = 0.45
"""Free floor between the chairs of two tables."""
_BESIDE_DESK_M: Final = 0.65


def work_groups(pool: Pool) -> list[FurnitureGroup | Rows]:
    """Return desks and cubicles with their chairs and drawers."""
    desks = pool.take(pool.of(*_WORK))
    others = [p for p in pool.rest if p.role is FurnitureRole.TABLE]
    swivels = not others or len(pool.of("swivel_chair")) <= 2 * len(desks)
    return _in_rows(_workplaces(pool, desks, swivels=swivels), pool)


def table_groups(pool: Pool) -> list[FurnitureGroup | Rows]:
    """Return all other tables with their seats; spare seats stay in the pool."""
    groups: list[FurnitureGroup] = [*_booths(pool), *_bars(pool)]
    tables = sorted(_tables(pool), key=lambda t: -t.size_m[0] * t.size_m[1])
    found = _in_rows([*groups, *_sets(pool, tables)], pool)
    if len(pool.of("armchair")) >= 3 * ROW_OF and pool.room_type in _FACING:
        audience = [FurnitureGroup((Member(p),), Style.FREE, 6.0) for p in pool.take(pool.of("armchair"))]
        found.append(Rows(tuple(audience), 6.0, (_ROW_M + 0.3, 0.06)))
    return found


def _tables(pool: Pool) -> list[FurniturePiece]:
    tables = pool.take(p for p in pool.rest if p.role is FurnitureRole.TABLE)
    tables += pool.take(p for p in pool.of("coffee_table") if top_of(p) > _DINING_TOP_M)
    chairs = len(pool.of("straight_chair", "swivel_chair", "garden_chair"))
    if not tables and chairs >= 2:
        tables = pool.take(sorted(pool.of("coffee_table"), key=lambda p: -p.size_m[1])[:1])
    return tables


def _workplaces(pool: Pool, desks: Sequence[FurniturePiece], *, swivels: bool) -> list[FurnitureGroup]:
    """Return desks at the wall with a chair on the room's side; deep double desks get a chair on either side."""
    kinds = ("swivel_chair",) if swivels else ()
    kinds = (*kinds, "eames_chair", "straight_chair", "armchair" if pool.room_type in _EATING else "taboret")
    count = sum(len(pool.of(kind)) for kind in kinds)
    each = 2 if len(desks) and count >= 2 * len(desks) and min(desks[0].size_m[:2]) > 1.2 else 1
    drawers = [p for p in pool.of("bottom_cabinet") if p.size_m[2] <= _BESIDE_DESK_M]
    spare = len(drawers) // max(1, len(desks)) if len(desks) >= ROW_OF else 0
    groups = []
    for desk in desks:
        seats = pool.take([p for kind in kinds for p in pool.of(kind)][:each])
        members = before_table(desk, seats[:1]) + tuple(
            m for m in around_table(desk, seats)[2:] if len(seats) > 1
        )
        members = (*members, *_drawers_beside(desk, pool.take(drawers[: min(spare, each)])))
        drawers = drawers[min(spare, each) :]
        style = Style.FREE if pool.room_type in _FACING and len(desks) >= ROW_OF else Style.ALONG
        groups.append(FurnitureGroup(members, style, worth(members), spread=(desk.category,)))
    return groups


def _drawers_beside(desk: FurniturePiece, drawers: Sequence[FurniturePiece]) -> list[Member]:
    """Return low cabinets at the sides of a desk: the first opens to the chair's side, the second to the other."""
    found = []
    for drawer, side in zip(drawers, (1, -1), strict=False):
        x = side * (desk.size_m[0] - drawer.size_m[0]) / 2
        y = side * ((desk.size_m[1] + drawer.size_m[1]) / 2 + 0.01)
        found.append(Member(drawer, x, y, turns=0 if side > 0 else 2))
    return found


def _sets(pool: Pool, tables: Sequence[FurniturePiece]) -> list[FurnitureGroup]:
    """Return tables with seats shared among them, in the middle of the room; tables without seats go to a wall."""
    high = [t for t in tables if top_of(t) > _HIGH_TABLE_M]
    stools = pool.of(*STOOLS)
    seats = pool.of("straight_chair", "garden_chair", "eames_chair", "swivel_chair", "rocking_chair")
    if pool.room_type in _EATING and len(seats) < 2 * len(tables):
        seats += pool.of("armchair")
    if not high:
        seats += stools
    one_side = pool.room_type in _FACING and len(tables) >= ROW_OF
    return [
        *_shared(pool, high, stools, one_side),
        *_shared(pool, [t for t in tables if t not in high], seats, one_side),
    ]


def _shared(
    pool: Pool, tables: Sequence[FurniturePiece], seats: list[FurniturePiece], one_side: bool
) -> list[FurnitureGroup]:
    """Share seats among tables as evenly as possible."""
    pool.take(seats)
    groups = []
    for number, table in enumerate(tables):
        share = -(-len(seats) // (len(tables) - number))
        share = min(share, seats_around(table, seats[0].size_m[1]) if seats else 0)
        mine, seats = seats[:share], seats[share:]
        members = before_table(table, mine) if one_side else around_table(table, mine)
        seated = {m.piece.number for m in members}
        seats = [s for s in mine if s.number not in seated] + seats
        style = Style.FREE if len(members) > 2 or (one_side and mine) else Style.ALONG
        clear = _SET_CLEAR_M if style is Style.FREE else 0.0
        groups.append(FurnitureGroup(members, style, worth(members), spread=(table.category,), clear_m=clear))
    pool.rest += seats
    return groups


def _in_rows(groups: Sequence[FurnitureGroup], pool: Pool) -> list[FurnitureGroup | Rows]:
    """Combine four or more sets of about one size into rows."""
    found: list[FurnitureGroup | Rows] = []
    for equal in _alike(groups):
        if len(equal) < ROW_OF or len(equal[0].members) < 2:
            found += equal
            continue
        work = equal[0].members[0].piece.category in _WORK
        gap = (_ROW_M, _WALK_M) if pool.room_type in _FACING else (_WALK_M, 0.05 if work else _SEAT_M)
        clear = 0.0 if work else min(gap)
        found.append(Rows(tuple(equal), max(g.importance for g in equal), gap, clear_m=clear))
    return found


def _alike(groups: Sequence[FurnitureGroup]) -> list[list[FurnitureGroup]]:
    """Collect groups of one style with sides that differ by less than a factor of ALIKE, large ones first."""
    kinds: list[list[FurnitureGroup]] = []
    for group in sorted(groups, key=lambda g: -_side(g)):
        for kind in kinds:
            work = group.members[0].piece.category in _WORK
            same = kind[0].style is group.style and work == (kind[0].members[0].piece.category in _WORK)
            if same and _side(kind[0]) <= ALIKE * _side(group) and len(group.members) > 1:
                kind.append(group)
                break
        else:
            kinds.append([group])
    return kinds


def _side(group: FurnitureGroup) -> float:
    x0, y0, x1, y1 = group.bounds
    return max(x1 - x0, y1 - y0)


def _booths(pool: Pool) -> list[FurnitureGroup]:
    """Return tables end-on to the wall with a bench on either side that faces them."""
    groups = []
    benches = pool.of("bench")
    tables = pool.of("booth")
    if not tables and len(benches) >= 2 and pool.room_type == "dining_room":
        tables = [t for t in pool.of("breakfast_table") if 0.5 <= benches[0].size_m[1] / t.size_m[1] <= 1.5]
        tables = tables[: len(benches) // 2]
    for table in tables:
        mine = [b for b in pool.of("bench") if 0.5 <= b.size_m[1] / table.size_m[1] <= 1.5][:2]
        pool.take([table, *mine])
        members = [Member(table, turns=1)]
        for bench, side in zip(mine, (1, -1), strict=False):
            offset = table.size_m[0] / 2 + _KNEE_M + bench.size_m[0] / 2
            members.append(Member(bench, 0.0, side * offset, turns=3 if side > 0 else 1))
        groups.append(FurnitureGroup(tuple(members), Style.ALONG, worth(members), near=("booth", "bench")))
    return groups


def _bars(pool: Pool) -> list[FurnitureGroup]:
    """Return bars along a wall with stools, the longest bar first."""
    groups = []
    bars = pool.take(sorted(pool.of("bar"), key=lambda p: -p.size_m[1]))
    for bar in bars:
        room = int(bar.size_m[1] / 0.55)
        stools = pool.take(pool.of(*STOOLS)[:room])
        pitch = bar.size_m[1] / (len(stools) + 1)
        members = [Member(bar)]
        for place, stool in enumerate(stools):
            x = bar.size_m[0] / 2 + _STOOL_GAP_M + stool.size_m[0] / 2
            members.append(Member(stool, x, (place + 1) * pitch - bar.size_m[1] / 2, turns=2))
        groups.append(FurnitureGroup(tuple(members), Style.ALONG, worth(members)))
    return groups
