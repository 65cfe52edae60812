"""Grouping: which pieces of a room belong together (counters, seating, table sets) and in what order they are placed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.factory.floorplan_walls import WALL_HEIGHT_M
from embomatrix.factory.furnish_pieces import (
    REST_GAP_M,
    Group,
    Member,
    Piece,
    Style,
    around_table,
    stacked,
    top_of,
)
from embomatrix.factory.furnish_roles import HUNG_BOTTOM_M, Role, importance_of, wall_height_m

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

_KNEE_M: Final = 0.05
_COFFEE_GAP_M: Final = 0.38
_UNDER_COUNTER: Final = (
    "bottom_cabinet",
    "bottom_cabinet_no_top",
    "dishwasher",
    "oven",
    "metal_bottom_cabinet",
)
_TV_STANDS: Final = ("console_table", "bottom_cabinet", "bookcase", "coffee_table", "breakfast_table")
_COOKERS: Final = ("stove", "flat_top_grill", "oven")
_SINKS: Final = ("furniture_sink", "pedestal_sink", "commercial_kitchen_sink", "wall_mounted_sink")
_NEAR_ON_WALL: Final[Mapping[str, tuple[str, ...]]] = {
    "mirror": _SINKS,
    "toilet_paper_dispenser": ("toilet",),
}
_HEAD_ROOM_M: Final = 1.45
_ISLAND_M: Final = 2.0
"""Longer kitchen tables stand in the middle of the kitchen."""


class _Pool:
    """The room's pieces that no group has taken yet."""

    def __init__(self, pieces: Iterable[Piece]) -> None:
        self.rest = list(pieces)

    def of(self, *categories: str) -> list[Piece]:
        return [p for c in categories for p in self.rest if p.category == c]

    def with_role(self, role: Role) -> list[Piece]:
        return [p for p in self.rest if p.role is role]

    def take(self, pieces: Iterable[Piece]) -> list[Piece]:
        taken = list(pieces)
        self.rest = [p for p in self.rest if all(p is not t for t in taken)]
        return taken


def floor_groups(pieces: Sequence[Piece]) -> tuple[list[Group], list[str]]:
    """Everything that stands on the floor, as groups, the important ones first; and a sentence for what is left out."""
    pool = _Pool(p for p in pieces if p.role not in (Role.WALL, Role.CEILING, Role.RUG, Role.HUNG_CABINET))
    left_out: list[str] = []
    groups = [
        *_television(pool),
        *_counters(pool, left_out),
        *_booths(pool),
        *_bars(pool),
        *_beds(pool),
        *_sofas(pool),
        *_table_sets(pool),
        *_singles(pool),
    ]
    groups.sort(key=lambda g: (-g.importance, -_area(g)))
    return groups, left_out


def hung_groups(pieces: Sequence[Piece]) -> list[Group]:
    """Wall cabinets and hoods over the counters, then what hangs on the walls, big things first."""
    groups = []
    for piece in pieces:
        if piece.role is Role.HUNG_CABINET:
            hood = piece.category == "range_hood"
            near: tuple[str, ...] = _COOKERS if hood else ("countertop", *_SINKS, *_UNDER_COUNTER)
            bottom = min(HUNG_BOTTOM_M + 0.1 * hood, WALL_HEIGHT_M - piece.size_m[2] - 0.01)
            groups.append(Group((Member(piece, bottom=bottom),), Style.RUN, 8.0 if hood else 5.0, near))
        elif piece.role is Role.WALL:
            height = piece.size_m[2]
            bottom = min(max(0.05, wall_height_m(piece.category) - height / 2), WALL_HEIGHT_M - height - 0.02)
            near = _NEAR_ON_WALL.get(piece.category, ())
            faces = ("sofa", "bar") if piece.category == "wall_mounted_tv" else ()
            style = Style.ALONG if near or faces or piece.size_m[1] < 0.3 else Style.CENTERED
            spread = (piece.category,)
            groups.append(
                Group((Member(piece, bottom=bottom),), style, 1.0 + piece.size_m[1], near, faces, spread)
            )
    return sorted(groups, key=lambda g: -g.importance)


def ceiling_groups(pieces: Sequence[Piece]) -> list[Group]:
    """Lights, fans and racks under the ceiling; those that hang low go over a table."""
    groups = []
    for piece in pieces:
        if piece.role is Role.CEILING:
            bottom = WALL_HEIGHT_M - piece.size_m[2]
            low = bottom < _HEAD_ROOM_M
            tables = (
                ("booth", "pedestal_table", "breakfast_table", "commercial_kitchen_table", "bar")
                if low
                else ()
            )
            member = Member(piece, bottom=max(bottom, 0.9))
            groups.append(
                Group((member,), Style.OVERHEAD, 1.0 + piece.size_m[1], tables, spread=(piece.category,))
            )
    return sorted(groups, key=lambda g: -g.importance)


def rug_groups(pieces: Sequence[Piece]) -> list[Group]:
    """Rugs lie on free floor before the sofa, the bed or the sink."""
    near = ("coffee_table", "sofa", "bed", "shower_stall", "bathtub", "pedestal_sink")
    return [
        Group((Member(p, bottom=REST_GAP_M),), Style.FREE, 1.0, near, spread=("carpet",))
        for p in pieces
        if p.role is Role.RUG
    ]


def _area(group: Group) -> float:
    x0, y0, x1, y1 = group.bounds
    return (x1 - x0) * (y1 - y0)


def _worth(members: Sequence[Member]) -> float:
    return max(importance_of(m.piece.category, m.piece.role) for m in members) + 0.1 * len(members)


def _television(pool: _Pool) -> list[Group]:
    groups = []
    for tv in pool.of("standing_tv"):
        stands = [
            p
            for p in pool.of(*_TV_STANDS)
            if top_of(p) <= 0.75 and p.size_m[0] >= 0.9 * tv.size_m[0] and p.size_m[1] >= 0.7 * tv.size_m[1]
        ]
        if stands:
            stand = pool.take([stands[0]])[0]
            base = Member(stand)
            members = (base, stacked(base, pool.take([tv])[0], 0))
            groups.append(Group(members, Style.CENTERED, 9.05, faces=("sofa", "armchair")))
    return groups


def _counters(pool: _Pool, left_out: list[str]) -> list[Group]:
    """Slabs over base cabinets and low appliances: first fit, widest first, close in height."""
    groups = []
    slabs = pool.of("countertop")
    while slabs:
        slab = slabs[0]
        width = slab.size_m[1]
        candidates = sorted(
            (p for p in pool.of(*_UNDER_COUNTER) if p.size_m[2] <= 0.95 and p.size_m[1] <= width + 0.02),
            key=lambda p: (p.category == "oven", -p.size_m[1]),
        )
        row = _best_row(candidates, width + 0.01)
        if sum(p.size_m[1] for p in row) < 0.55 * width:
            break
        pool.take([slab, *row])
        slabs.pop(0)
        members = _counter_members(slab, row)
        groups.append(
            Group(members, Style.RUN, 10.5 + _worth(members) / 100, near=(*_SINKS, "stove", "countertop"))
        )
    if slabs:
        pool.take(slabs)
        left_out.append(
            f"{len(slabs)} of the {slabs[0].asset.asset_id} slabs: no base cabinets are left to carry them"
        )
    return groups


def _best_row(candidates: Sequence[Piece], width: float) -> list[Piece]:
    """The fullest row of pieces of about one height that fits under a slab."""
    best: list[Piece] = []
    for first in range(len(candidates)):
        row: list[Piece] = []
        used = 0.0
        for piece in candidates[first:]:
            level = row[0].size_m[2] if row else piece.size_m[2]
            if used + piece.size_m[1] + 0.003 <= width and abs(piece.size_m[2] - level) <= 0.035:
                row.append(piece)
                used += piece.size_m[1] + 0.003
        if used > sum(p.size_m[1] + 0.003 for p in best) + 0.02:
            best = row
    return best


def _counter_members(slab: Piece, row: Sequence[Piece]) -> tuple[Member, ...]:
    """Cabinets side by side, backs aligned with the slab's, the slab on the tallest of them."""
    total = sum(p.size_m[1] + 0.003 for p in row) - 0.003
    left = -total / 2
    members = []
    back = -slab.size_m[0] / 2
    for piece in row:
        depth, width, _ = piece.size_m
        members.append(Member(piece, back + depth / 2, left + width / 2))
        left += width + 0.003
    tallest = max(range(len(row)), key=lambda i: row[i].size_m[2])
    bottom = row[tallest].size_m[2] + REST_GAP_M
    return (*members, Member(slab, bottom=bottom, on=tallest))


def _booths(pool: _Pool) -> list[Group]:
    """A booth table end-on to the wall, with a bench on either side facing it."""
    groups = []
    for table in pool.of("booth"):
        benches = pool.of("bench")[:2]
        pool.take([table, *benches])
        members = [Member(table, turns=1)]
        for bench, side in zip(benches, (1, -1), strict=False):
            offset = table.size_m[0] / 2 + _KNEE_M + bench.size_m[0] / 2
            members.append(Member(bench, 0.0, side * offset, turns=3 if side > 0 else 1))
        groups.append(Group(tuple(members), Style.ALONG, _worth(members), near=("booth",)))
    return groups


def _bars(pool: _Pool) -> list[Group]:
    groups = []
    stools = pool.take(pool.of("taboret")) if pool.of("bar") else []
    for bar in pool.take(pool.of("bar")):
        pitch = bar.size_m[1] / (len(stools) + 1) if stools else 0.0
        members = [Member(bar)]
        for place, stool in enumerate(stools):
            x = bar.size_m[0] / 2 + 0.15 + stool.size_m[0] / 2
            members.append(Member(stool, x, (place + 1) * pitch - bar.size_m[1] / 2, turns=2))
        groups.append(Group(tuple(members), Style.ALONG, _worth(members)))
        stools = []
    return groups


def _beds(pool: _Pool) -> list[Group]:
    groups = []
    for bed in pool.take(pool.of("bed", "hospital_bed")):
        members = [Member(bed)]
        for stand, side in zip(pool.take(pool.of("nightstand")[:2]), (1, -1), strict=False):
            x = (stand.size_m[0] - bed.size_m[0]) / 2
            members.append(Member(stand, x, side * (bed.size_m[1] + stand.size_m[1] + 0.08) / 2))
        groups.append(Group(tuple(members), Style.CENTERED, _worth(members)))
    return groups


def _sofas(pool: _Pool) -> list[Group]:
    groups = []
    for sofa in pool.take(sorted(pool.of("sofa"), key=lambda p: -p.size_m[1])):
        members = [Member(sofa)]
        for table in pool.take(pool.of("coffee_table")[:1]):
            members.append(Member(table, sofa.size_m[0] / 2 + _COFFEE_GAP_M + table.size_m[0] / 2))
        groups.append(Group(tuple(members), Style.CENTERED, _worth(members), faces=("standing_tv",)))
    return groups


def _table_sets(pool: _Pool) -> list[Group]:
    """Desks with one chair at a wall; dining tables with chairs around; tables without chairs along a wall."""
    swivels = pool.take(pool.of("swivel_chair", "eames_chair"))
    chairs = pool.take(pool.of("straight_chair", "garden_chair"))
    tables = pool.take(p for p in pool.rest if p.role is Role.TABLE)
    if not tables and len(chairs) >= 2:
        tables = pool.take(pool.of("coffee_table")[:1])
    desks = [t for t in tables if t.category == "desk"]
    spare = len(tables) - (len(chairs) >= 2)
    if swivels and not desks and spare > 0:
        desks = tables[-min(len(swivels), spare) :]
    dining = [t for t in tables if all(t is not d for d in desks)]
    groups = []
    for desk in desks:
        seats = swivels[:1] or chairs[:1]
        swivels, chairs = swivels[1:], chairs if swivels else chairs[1:]
        groups.append(_set(around_table(desk, seats), Style.ALONG))
    even = len(chairs) >= 2 * len(dining)
    for number, table in enumerate(dining):
        share = -(-len(chairs) // (len(dining) - number)) if even else 6
        seats, chairs = chairs[: min(share, 8)], chairs[min(share, 8) :]
        members = around_table(table, seats)
        seated = {id(m.piece) for m in members}
        chairs = [c for c in seats if id(c) not in seated] + chairs
        groups.append(_set(members, Style.FREE if len(members) > 2 else Style.ALONG))
    pool.rest += chairs + swivels
    return groups


def _set(members: tuple[Member, ...], style: Style) -> Group:
    return Group(
        members, style, _worth(members), spread=tuple(sorted({m.piece.category for m in members[:1]}))
    )


def _singles(pool: _Pool) -> list[Group]:
    styles = {Role.RUN: Style.RUN, Role.CORNER: Style.CORNER}
    near: dict[str, tuple[str, ...]] = {
        "armchair": ("coffee_table", "sofa"),
        "ottoman": ("sofa", "armchair"),
        "floor_lamp": ("sofa", "armchair", "bed"),
        "standing_loudspeaker": ("standing_tv", "sofa"),
        "stove": (*_SINKS, *_COOKERS),
        "oven": (*_SINKS, *_COOKERS),
        "flat_top_grill": _COOKERS,
        "deep_fryer": _COOKERS,
        "public_trash_can": _SINKS,
        "trash_can": _SINKS,
    }
    groups = []
    for piece in pool.take(p for p in pool.rest if p.role not in (Role.SURFACE, Role.STRUCTURE)):
        style = styles.get(piece.role, Style.ALONG)
        if piece.category == "commercial_kitchen_table" and piece.size_m[1] > _ISLAND_M:
            style = Style.FREE
        members = (Member(piece),)
        run = ("countertop", "stove", "fridge", *_SINKS) if style is Style.RUN else ()
        groups.append(Group(members, style, _worth(members), near.get(piece.category, run)))
    return groups
