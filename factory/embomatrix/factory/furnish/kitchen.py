"""Runs along the walls: worktops over base cabinets and low appliances, with sinks and cookers set into the line."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from embomatrix.factory.furnish.pieces import (
    REST_GAP_M,
    FurnitureGroup,
    FurniturePiece,
    Member,
    Pool,
    Style,
    before_table,
    stacked,
    top_of,
)
from embomatrix.factory.furnish.roles import FurnitureRole

Unplaced = tuple[FurniturePiece, str]

UNDER_COUNTER: Final = (
    "bottom_cabinet",
    "bottom_cabinet_no_top",
    "dishwasher",
    "oven",
    "metal_bottom_cabinet",
)
COOKERS: Final = ("stove", "flat_top_grill", "oven", "burner")
SINKS: Final = (
    "furniture_sink",
    "pedestal_sink",
    "commercial_kitchen_sink",
    "wall_mounted_sink",
    "drop_in_sink",
    "tabletop_sink",
    "multi_station_tabletop_sink",
    "multi_station_furniture_sink",
)
FITTED: Final = (
    "drop_in_sink",
    "tabletop_sink",
    "multi_station_tabletop_sink",
    "burner",
)
"""Categories that are set into a counter for good."""
_RUN_WORTH: Final = 20.5
"""Importance of runs, above that of other furniture: a kitchen needs its line of cabinets."""
_FILLED: Final = 0.55
"""Share of a worktop's width that the cabinets below it must fill to carry it."""
_CARRIED: Final = 0.3
"""The same share for a single cabinet, if the worktop would otherwise be left over: a peninsula."""
_STEP_M: Final = 0.003
_LEVEL_M: Final = 0.035
_HIGHEST_M: Final = 0.95
_OVERHANG_M: Final = 0.15
"""Greatest overhang of a worktop over the fronts below it."""
_WORKTOP_M: Final = 0.72
_BASIN_RIM_M: Final = 0.86


def run_groups(pool: Pool, left_out: list[Unplaced]) -> list[FurnitureGroup]:
    """Return everything that stands in lines along the walls, in the order of a kitchen: cold, wet, work, hot, the rest."""
    counters = _counters(pool, left_out)
    _fit(pool, counters)
    counters = [_with_chair(pool, group) for group in counters]
    basins = [basin(p) for p in pool.take(p for p in pool.of(*FITTED) if p.category != "burner")]
    for burner in pool.take(pool.of("burner")):
        left_out.append((burner, "no counter is left to carry it"))
    units = [
        FurnitureGroup((Member(p),), Style.RUN, 0.0) for p in pool.take(pool.with_role(FurnitureRole.RUN))
    ]
    ordered = _in_order([*counters, *units])
    near = ("countertop", *SINKS, "stove", "fridge", *UNDER_COUNTER)
    lined = [
        FurnitureGroup(g.members, Style.RUN, _RUN_WORTH - 0.01 * i, near=near if i else ())
        for i, g in enumerate(ordered)
    ]
    return [*lined, *basins]


def _in_order(units: Sequence[FurnitureGroup]) -> list[FurnitureGroup]:
    """Order units so that the fridge comes first and every cooker and sink has a counter beside it."""
    counters = [g for g in units if any(_is_counter(m.piece) for m in g.members)]
    rest = [g for g in units if all(not _is_counter(m.piece) for m in g.members)]
    rank = {"fridge": 0, **dict.fromkeys(SINKS, 1), "dishwasher": 2, **dict.fromkeys(COOKERS, 3)}
    rest.sort(key=lambda g: (rank.get(g.members[0].piece.category, 4), -_width(g)))
    counters.sort(key=lambda g: (all(m.piece.category != "dishwasher" for m in g.members), -_width(g)))
    ordered: list[FurnitureGroup] = []
    for place, unit in enumerate(rest):
        ordered.append(unit)
        hot_or_wet = rank.get(unit.members[0].piece.category, 4) in (0, 1, 3)
        if counters and hot_or_wet and place < len(rest):
            ordered.append(counters.pop(0))
    return ordered + counters


def _width(group: FurnitureGroup) -> float:
    _, y0, _, y1 = group.bounds
    return y1 - y0


def _is_counter(piece: FurniturePiece) -> bool:
    return piece.category in ("countertop", "bar")


def _counters(pool: Pool, left_out: list[Unplaced]) -> list[FurnitureGroup]:
    """Return worktops over base cabinets and low appliances of about one height, the widest first."""
    groups: list[FurnitureGroup] = []
    left: list[FurniturePiece] = []
    for slab in pool.take(sorted(pool.of("countertop"), key=lambda p: -p.size_m[1])):
        row = _carriers(pool, slab)
        if row:
            pool.take(row)
            groups.append(FurnitureGroup(_counter_members(slab, row), Style.RUN, 0.0))
        else:
            left.append(slab)
    if left and not groups and pool.room_type != "kitchen":
        # A worktop on side panels, as in a washroom or a copy room.
        groups.append(worktop(left.pop(0)))
    left_out += [(slab, "no base cabinet of counter height is left to carry it") for slab in left]
    groups += [
        FurnitureGroup((Member(bar),), Style.RUN, 0.0)
        for bar in pool.take(p for p in pool.of("bar") if pool.room_type == "kitchen" and p.size_m[0] <= 0.75)
    ]
    return groups


def _carriers(pool: Pool, slab: FurniturePiece) -> list[FurniturePiece]:
    """Return the cabinets of about one height that fill the worktop's width best; empty if they fill too little."""
    width = slab.size_m[1]
    candidates = sorted(
        (p for p in pool.of(*UNDER_COUNTER) if p.size_m[2] <= _HIGHEST_M and p.size_m[1] <= width + 0.02),
        key=lambda p: (p.category != "dishwasher", p.category == "oven", -p.size_m[1]),
    )
    row = _best_row(candidates, width + 0.01)
    filled = sum(p.size_m[1] for p in row) / width
    if filled >= _FILLED or (len(row) == 1 and filled >= _CARRIED and row[0].category != "oven"):
        return row
    return []


def _best_row(candidates: Sequence[FurniturePiece], width: float) -> list[FurniturePiece]:
    """Return the fullest row of pieces of about one height that fits under a worktop."""
    best: list[FurniturePiece] = []
    for first in range(len(candidates)):
        row: list[FurniturePiece] = []
        used = 0.0
        for piece in candidates[first:]:
            level = row[0].size_m[2] if row else piece.size_m[2]
            if used + piece.size_m[1] + _STEP_M <= width and abs(piece.size_m[2] - level) <= _LEVEL_M:
                row.append(piece)
                used += piece.size_m[1] + _STEP_M
        if used > sum(p.size_m[1] + _STEP_M for p in best) + 0.02:
            best = row
    return best


def _counter_members(slab: FurniturePiece, row: Sequence[FurniturePiece]) -> tuple[Member, ...]:
    """Return cabinets side by side with their backs aligned, and the worktop on the tallest of them.

    Under a deep worktop the cabinets move forward: the robot opens them while it stands before the worktop's edge.
    """
    total = sum(p.size_m[1] + _STEP_M for p in row) - _STEP_M
    left = -total / 2
    members = []
    back = -slab.size_m[0] / 2
    for piece in row:
        depth, width, _ = piece.size_m
        forward = max(0.0, slab.size_m[0] - depth - _OVERHANG_M)
        members.append(Member(piece, back + forward + depth / 2, left + width / 2))
        left += width + _STEP_M
    tallest = max(range(len(row)), key=lambda i: row[i].size_m[2])
    bottom = row[tallest].size_m[2] + REST_GAP_M
    return (*members, Member(slab, bottom=bottom, on=tallest))


def _fit(pool: Pool, counters: list[FurnitureGroup]) -> None:
    """Set basins and cooktops on counters as long as there is space, else on base cabinets."""
    for piece in sorted(pool.of(*FITTED), key=lambda p: -p.size_m[1]):
        for number, group in enumerate(counters):
            spot = _free_span(group, piece)
            if spot is not None:
                slab = len(_carcass(group)) - 1
                base = group.members[slab]
                top = stacked(base, piece, slab)
                member = Member(piece, top.x, spot, top.bottom, on=slab)
                counters[number] = _evened(FurnitureGroup((*group.members, member), Style.RUN, 0.0))
                pool.take([piece])
                break
        else:
            _fit_on_cabinet(pool, counters, piece)


def _fit_on_cabinet(pool: Pool, counters: list[FurnitureGroup], piece: FurniturePiece) -> None:
    for cabinet in pool.of("bottom_cabinet", "bottom_cabinet_no_top", "metal_bottom_cabinet"):
        low = cabinet.size_m[2] <= _HIGHEST_M
        if low and cabinet.size_m[1] >= 0.8 * piece.size_m[1] and cabinet.size_m[0] >= 0.7 * piece.size_m[0]:
            pool.take([cabinet, piece])
            base = Member(cabinet)
            shift = max(0.0, (piece.size_m[0] - cabinet.size_m[0]) / 2)
            top = stacked(base, piece, 0)
            counters.append(
                FurnitureGroup((base, Member(piece, shift, 0.0, top.bottom, on=0)), Style.RUN, 0.0)
            )
            return


def _carcass(group: FurnitureGroup) -> list[Member]:
    """Return the members without those set into the worktop; the last one is the worktop."""
    return [m for m in group.members if m.piece.category not in FITTED]


def _free_span(group: FurnitureGroup, piece: FurniturePiece) -> float | None:
    """Return the y at which the piece fits beside those already set into the counter; None if there is no space."""
    slab = _carcass(group)[-1]
    if piece.size_m[0] > slab.piece.size_m[0] + 0.1 or top_of(slab.piece) + slab.bottom > _HIGHEST_M + 0.1:
        return None
    fitted = [m for m in group.members if m.piece.category in FITTED]
    used = sum(m.piece.size_m[1] + 0.1 for m in fitted)
    width = slab.piece.size_m[1]
    if used + piece.size_m[1] > width + 1e-6:
        return None
    return slab.y - width / 2 + used + piece.size_m[1] / 2


def _evened(group: FurnitureGroup) -> FurnitureGroup:
    """Return the counter with equal gaps between the basins and cooktops set into it."""
    carcass = _carcass(group)
    fitted = [m for m in group.members if m.piece.category in FITTED]
    slab = carcass[-1]
    gap = (slab.piece.size_m[1] - sum(m.piece.size_m[1] for m in fitted)) / (len(fitted) + 1)
    left = slab.y - slab.piece.size_m[1] / 2
    members = []
    for member in fitted:
        members.append(replace(member, y=left + gap + member.piece.size_m[1] / 2))
        left += gap + member.piece.size_m[1]
    return replace(group, members=(*carcass, *members))


def worktop(slab: FurniturePiece) -> FurnitureGroup:
    """Return a worktop on side panels at the wall, without cabinets under it."""
    return FurnitureGroup((Member(slab, bottom=_WORKTOP_M),), Style.RUN, 0.0, near=SINKS)


def _with_chair(pool: Pool, group: FurnitureGroup) -> FurnitureGroup:
    """Add a spare swivel chair to a worktop on side panels, unless a conference table needs the chairs."""
    slab = group.members[0]
    if (
        len(group.members) > 1
        or slab.piece.role is not FurnitureRole.COUNTERTOP
        or pool.of("conference_table")
    ):
        return group
    _, *chairs = before_table(slab.piece, pool.take(pool.of("swivel_chair")[:1]))
    return replace(group, members=(slab, *chairs))


def basin(piece: FurniturePiece) -> FurnitureGroup:
    """Return a basin or cooktop that hangs on the wall, for lack of a counter."""
    bottom = max(0.4, _BASIN_RIM_M - piece.size_m[2])
    return FurnitureGroup((Member(piece, bottom=bottom),), Style.ALONG, 12.0, near=SINKS)
