"""Groups of shops, gardens and halls: lines of shelves, plants along the edges, mats and machines in the open."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Final

from embomatrix.factory.furnish.pieces import FurnitureGroup, FurniturePiece, Member, Pool, Rows, Style, worth
from embomatrix.factory.furnish.roles import FurnitureRole

_SHELVES: Final = ("grocery_shelf", "snack_rack", "dry_food_dispenser_shelf", "candy_dispenser_shelf")
_TALL_M: Final = 1.9
"""Taller shelves stand at the walls as long as there is space."""
_AISLE_M: Final = 1.0
_WALKS_M: Final = 3.2
"""Length that a line of shelves leaves free at both ends together, shelves at the walls included."""
_LONGEST_LINE_M: Final = 9.0
_STEP_M: Final = 0.005
_PLANTS_WORTH: Final = 0.5
_MATS: Final = 4


def hall_groups(pool: Pool) -> list[FurnitureGroup | Rows]:
    """Return the groups of large rooms: shelves in aisles, machines in the open."""
    found: list[FurnitureGroup | Rows] = [*_aisles(pool)]
    standing = pool.take(pool.with_role(FurnitureRole.OPEN))
    if pool.room_type == "gym" and len(standing) >= _MATS:
        machines = tuple(FurnitureGroup((Member(p),), Style.FREE, worth([Member(p)])) for p in standing)
        found.append(Rows(machines, 6.0, (_AISLE_M, _AISLE_M)))
        standing = []
    for piece in standing:
        near = ("doorway",) if piece.category == "turnstile" else ()
        members = (Member(piece),)
        found.append(
            FurnitureGroup(
                members, Style.FREE, worth(members), near, spread=(piece.category,), clear_m=_AISLE_M
            )
        )
    return found


def planting_groups(pool: Pool) -> list[FurnitureGroup]:
    """Return trees, bushes and stones, the largest first, at an importance below all furniture."""
    plants = pool.take(pool.with_role(FurnitureRole.PLANTING))
    plants.sort(key=lambda p: -p.size_m[0] * p.size_m[1])
    return [FurnitureGroup((Member(p),), Style.EDGE, _PLANTS_WORTH) for p in plants]


def mat_rows(pool: Pool) -> list[Rows]:
    """Return rows of equal mats, side by side."""
    kinds: dict[str, list[FurniturePiece]] = defaultdict(list)
    for piece in pool.of("gym_mat"):
        kinds[piece.asset.asset_id].append(piece)
    rows = []
    for mats in kinds.values():
        if len(mats) >= _MATS:
            pool.take(mats)
            rows.append(
                Rows(tuple(FurnitureGroup((Member(m),), Style.FREE, 1.0) for m in mats), 1.0, (0.02, 0.02))
            )
    return rows


def _aisles(pool: Pool) -> list[FurnitureGroup]:
    """Return the shelves of a shop: tall ones along the walls, the others back to back in lines across the hall."""
    shelves = pool.of(*_SHELVES)
    if pool.room_type != "grocery_store" or len(shelves) < 2 * _MATS:
        return []
    pool.take(shelves)
    walls = 2 * sum(pool.floor_m) * 0.6
    at_wall: list[FurniturePiece] = []
    for shelf in sorted(shelves, key=lambda p: -p.size_m[2]):
        if shelf.size_m[2] >= _TALL_M and sum(p.size_m[1] for p in at_wall) + shelf.size_m[1] <= walls:
            at_wall.append(shelf)
    wall_numbers = {p.number for p in at_wall}
    free = [p for p in shelves if p.number not in wall_numbers]
    groups = [
        FurnitureGroup((Member(p),), Style.RUN, 9.0 + 0.1 * p.size_m[1], near=("grocery_shelf",))
        for p in at_wall
    ]
    longest = min(min(pool.floor_m) - _WALKS_M, _LONGEST_LINE_M)
    lines = _lines(sorted(free, key=lambda p: (-p.size_m[0].__round__(1), -p.size_m[1])), longest)
    for front, back in zip(lines[::2], [*lines[1::2], []], strict=False):
        members = (*_line(front, 0), *_line(back, 2))
        groups.append(FurnitureGroup(members, Style.AISLE, 8.5 + 0.1 * len(members), clear_m=_AISLE_M))
    return groups


def _lines(shelves: Sequence[FurniturePiece], longest: float) -> list[list[FurniturePiece]]:
    lines: list[list[FurniturePiece]] = []
    used = 0.0
    for shelf in shelves:
        if lines and used + shelf.size_m[1] + _STEP_M <= longest:
            lines[-1].append(shelf)
            used += shelf.size_m[1] + _STEP_M
        else:
            lines.append([shelf])
            used = shelf.size_m[1]
    return lines


def _line(shelves: Sequence[FurniturePiece], turns: int) -> list[Member]:
    """Return shelves side by side with their backs on the group's y axis, facing +x or -x."""
    total = sum(p.size_m[1] + _STEP_M for p in shelves) - _STEP_M
    side = 1 if turns == 0 else -1
    at = -total / 2
    members = []
    for shelf in shelves:
        x = side * (shelf.size_m[0] / 2 + _STEP_M / 2)
        members.append(Member(shelf, x, at + shelf.size_m[1] / 2, turns=turns))
        at += shelf.size_m[1] + _STEP_M
    return members
