"""Furnishing: the inventory of every room, placed at its own sizes so that a robot can get to all that it may use."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from embomatrix.factory.floorplan.walls import WALL_HEIGHT_M
from embomatrix.factory.furnish.groups import alone, hung_and_laid, in_the_open, room_groups
from embomatrix.factory.furnish.pieces import Rows
from embomatrix.factory.furnish.roles import FurnitureRole, importance_of
from embomatrix.factory.furnish.rows import lay_rows
from embomatrix.factory.furnish.solver import RoomSolver
from embomatrix.factory.furnish.space import RoomSpace
from embomatrix.factory.furnish.surfaces import SurfacePlacer
from embomatrix.factory.furnish.tables import STOOLS
from embomatrix.skills.limits import ROBOT

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import numpy as np

    from embomatrix.factory.floorplan.layout import FloorPlan
    from embomatrix.factory.furnish.pieces import FurnitureGroup, FurniturePiece, Member, Placed
    from embomatrix.world.scene import Doorway, Room

ATTEMPTS: Final = 24
CROWDED_ATTEMPTS: Final = 6
"""Arrangements of a room that are tried before one that leaves something out is taken; fewer where there is much to place."""
CROWD: Final = 30
HALL: Final = 90
"""A room with more to place than this is arranged at most twice."""
GOOD_ENOUGH: Final = 2.0
"""After CROWDED_ATTEMPTS an arrangement that loses no more than this is taken: a trash can, a picture."""
_IN_THE_WAY: Final = "no free place keeps the room passable"
MAX_EQUAL: Final = 6
"""Small things and lights of one model in one room at most: the diner's kitchen lists 137 trays."""
MAX_FURNITURE: Final = 60
MAX_SEATS: Final = 120
MAX_PLANTS: Final = 24
"""Warehouses and woods: so many of a model stand for all of them."""
_CAPS: Final[Mapping[FurnitureRole, int]] = {
    FurnitureRole.SURFACE: MAX_EQUAL,
    FurnitureRole.CEILING: MAX_EQUAL,
    FurnitureRole.SEAT: MAX_SEATS,
    FurnitureRole.PLANTING: MAX_PLANTS,
}
_ABOVE_FLOOR_M: Final = 0.1
_PAST_M: Final = 2 * ROBOT.radius_m + 0.1
_LIGHT_LOSSES: Final = frozenset(
    (FurnitureRole.WALL, FurnitureRole.CEILING, FurnitureRole.RUG, FurnitureRole.PLANTING)
)
"""What finds no place of these is no reason to start again with it, unless the room is none without it: a basin."""
_WEIGHTY: Final = 10.0


@dataclass(frozen=True, slots=True)
class Furnishing:
    """Placed pieces of a whole plan, hosts by position in ``placed``, and what found no place, one sentence each."""

    placed: tuple[Placed, ...]
    left_out: tuple[str, ...]
    loss: float = 0.0
    """Importance of what found no place on floor, walls and ceilings, summed."""


@dataclass(frozen=True, slots=True)
class _Arrangement:
    placed: tuple[Placed, ...]
    dropped: tuple[FurniturePiece, ...]
    unfit: tuple[tuple[FurniturePiece, str], ...]
    """What no group takes, with the reason."""

    @property
    def loss(self) -> float:
        return sum(importance_of(p.category, p.role) for p in self.dropped)


def furnish(plan: FloorPlan, pieces: dict[str, list[FurniturePiece]], rng: np.random.Generator) -> Furnishing:
    """Place the pieces of every room of the plan; ``pieces`` maps room names to their inventories.

    Deterministic for a given generator state. What has no place is never dropped silently: see ``left_out``.
    """
    placed: list[Placed] = []
    left_out: list[str] = []
    small: list[tuple[str, FurniturePiece]] = []
    loss = 0.0
    pieces = _moved(plan, pieces)
    for room in plan.rooms:
        wanted, notes = _capped(pieces.get(room.name, []), room.name)
        best = _best_arrangement(room, plan, wanted, rng)
        start = len(placed)
        loss += best.loss
        placed += [replace(p, host=p.host + start) if p.host >= 0 else p for p in best.placed]
        left_out += [
            *notes,
            *(
                sentence
                for reason in dict.fromkeys(reason for _, reason in best.unfit)
                for sentence in _sentences([p for p, why in best.unfit if why == reason], room.name, reason)
            ),
            *_unplaced(best.dropped, room),
        ]
        done = {p.piece.number for p in best.placed} | {p.number for p in best.dropped}
        small += [(room.name, p) for p in wanted if p.role is FurnitureRole.SURFACE and p.number not in done]
    left_out += _set_small_things(plan, placed, small, rng)
    return Furnishing(tuple(placed), tuple(left_out), loss)


def _moved(
    plan: FloorPlan, pieces: Mapping[str, Sequence[FurniturePiece]]
) -> dict[str, list[FurniturePiece]]:
    """The inventories; a bar that its own room can't take stands in the room next door, and its stools with it."""
    rooms = {room.name: room for room in plan.rooms}
    moved: dict[str, list[FurniturePiece]] = {name: [] for name in rooms}
    for name, mine in pieces.items():
        beside = [_other(d, name) for d in plan.doorways if name in d.rooms and d.rooms[1]]
        large = [p for p in mine if p.category == "bar" and not _has_room(p, rooms[name])]
        home = next((other for other in beside if large and _has_room(large[0], rooms[other])), name)
        for piece in mine:
            goes = any(piece is bar for bar in large) or (bool(large) and piece.category in STOOLS)
            moved[home if goes else name].append(piece)
    return moved


def _has_room(piece: FurniturePiece, room: Room) -> bool:
    """Whether the robot gets past the piece when it stands at a wall."""
    short, long = sorted(piece.size_m[:2])
    return short + _PAST_M <= min(room.size_m) and long <= max(room.size_m)


def _capped(pieces: Sequence[FurniturePiece], room: str) -> tuple[list[FurniturePiece], list[str]]:
    """As many of each model as `_CAPS` allows, nothing that belongs to the building; with sentences on the rest."""
    kept: list[FurniturePiece] = []
    totals = Counter(p.asset.asset_id for p in pieces)
    seen: Counter[str] = Counter()
    for piece in pieces:
        seen[piece.asset.asset_id] += 1
        most = _CAPS.get(piece.role, MAX_FURNITURE)
        belongs = piece.role is not FurnitureRole.STRUCTURE and not _too_high(piece)
        if belongs and seen[piece.asset.asset_id] <= most:
            kept.append(piece)
    notes = []
    for piece in {p.asset.asset_id: p for p in pieces}.values():
        asset_id, total = piece.asset.asset_id, totals[piece.asset.asset_id]
        most = _CAPS.get(piece.role, MAX_FURNITURE)
        if piece.role is FurnitureRole.STRUCTURE:
            notes.append(
                f"{total} {asset_id} in {room}: part of the building, which floor and walls stand for"
            )
        elif _too_high(piece):
            notes.append(f"{total} {asset_id} in {room}: it hangs, and is higher than the room")
        elif total > most:
            notes.append(
                f"{total - most} of {total} {asset_id} in {room}: at most {most} of a model in a room"
            )
    return kept, notes


def _too_high(piece: FurniturePiece) -> bool:
    """Whether a thing for wall or ceiling has no room above the floor: lamps of a hall, screens of a theatre."""
    return (
        piece.role in (FurnitureRole.WALL, FurnitureRole.CEILING)
        and piece.size_m[2] > WALL_HEIGHT_M - _ABOVE_FLOOR_M
    )


def _best_arrangement(
    room: Room, plan: FloorPlan, pieces: Sequence[FurniturePiece], rng: np.random.Generator
) -> _Arrangement:
    best: _Arrangement | None = None
    first: set[int] = set()
    standing = sum(p.role not in (FurnitureRole.SURFACE, FurnitureRole.PLANTING) for p in pieces)
    attempts = ATTEMPTS if standing < CROWD else CROWDED_ATTEMPTS if standing < HALL else 2
    for attempt in range(attempts):
        tried = _arrange(room, plan, pieces, rng, first, wobble=0.4 + 0.2 * attempt)
        # What found no place comes first the next time.
        lost = [p for p in tried.dropped if _matters(p)]
        first |= {p.number for p in lost}
        if best is None or tried.loss < best.loss:
            best = tried
        if not lost or (attempt >= CROWDED_ATTEMPTS and best.loss <= GOOD_ENOUGH):
            break
    if best is None:
        raise ValueError(f"room {room.name!r} was never arranged: expected at least one attempt")
    return best


def _arrange(
    room: Room,
    plan: FloorPlan,
    pieces: Sequence[FurniturePiece],
    rng: np.random.Generator,
    first: set[int],
    *,
    wobble: float,
) -> _Arrangement:
    solver = RoomSolver(RoomSpace(room, plan.doorways, plan.windows), rng)
    groups, unfit = room_groups(pieces, room.type, room.size_m)
    groups.sort(key=lambda g: all(m.piece.number not in first for m in _members(g)))
    dropped = _place_all(solver, groups, wobble, rng)
    # What its group had no room for may still stand alone: a chair at the wall, an armchair in the corner.
    dropped = _place_all(solver, [alone(p) for p in dropped], wobble, rng)
    walls = [p for p in dropped if in_the_open(p) is None]
    dropped = walls + _place_all(solver, [g for p in dropped if (g := in_the_open(p))], wobble, rng)
    taken = {p.piece.number for p in solver.placed} | {p.number for p in dropped}
    dropped += _place_all(solver, hung_and_laid(pieces, taken), wobble, rng)
    return _Arrangement(tuple(solver.placed), tuple(dropped), tuple(unfit))


def _place_all(
    solver: RoomSolver, groups: Iterable[FurnitureGroup | Rows], wobble: float, rng: np.random.Generator
) -> list[FurniturePiece]:
    """Place group after group; returns the pieces that found no place."""
    dropped: list[FurniturePiece] = []
    hopeless: set[tuple[str, ...]] = set()
    for item in groups:
        for group in lay_rows(solver, item, wobble, rng) if isinstance(item, Rows) else (item,):
            remaining = group
            while _signature(remaining) in hopeless or not solver.place(remaining, wobble=wobble):
                # An equal group finds no place either: a room only fills up.
                hopeless.add(_signature(remaining))
                dropped.append(remaining.members[-1].piece)
                if len(remaining.members) == 1:
                    break
                # The last member is the least important one: a chair, a stool, the coffee table.
                remaining = replace(remaining, members=remaining.members[:-1])
    return dropped


def _matters(piece: FurniturePiece) -> bool:
    """Whether it is a reason to arrange the room anew that the piece found no place."""
    return piece.role not in _LIGHT_LOSSES or importance_of(piece.category, piece.role) >= _WEIGHTY


def _signature(group: FurnitureGroup) -> tuple[str, ...]:
    return (group.style, *(m.piece.asset.asset_id for m in group.members))


def _members(item: FurnitureGroup | Rows) -> tuple[Member, ...]:
    return tuple(m for g in item.groups for m in g.members) if isinstance(item, Rows) else item.members


def _set_small_things(
    plan: FloorPlan,
    placed: list[Placed],
    small: Sequence[tuple[str, FurniturePiece]],
    rng: np.random.Generator,
) -> list[str]:
    """Put small things on and in the furniture of their room, else of the room next door."""
    placer = SurfacePlacer(placed, rng)
    beside = {
        r.name: [_other(d, r.name) for d in plan.doorways if r.name in d.rooms and d.rooms[1]]
        for r in plan.rooms
    }
    dropped: dict[str, list[FurniturePiece]] = {}
    for room, piece in sorted(small, key=lambda item: -item[1].size_m[0] * item[1].size_m[1]):
        if not placer.place(piece, (room, *beside[room])):
            dropped.setdefault(room, []).append(piece)
    return [
        s for room, pieces in dropped.items() for s in _sentences(pieces, room, "no surface has room for it")
    ]


def _other(doorway: Doorway, room: str) -> str:
    return doorway.rooms[1] if doorway.rooms[0] == room else doorway.rooms[0]


def _unplaced(pieces: Sequence[FurniturePiece], room: Room) -> list[str]:
    """Sentences on what found no place on floor or walls: larger than the room, or in the way."""
    large = [
        p for p in pieces if max(p.size_m[:2]) > max(room.size_m) or min(p.size_m[:2]) > min(room.size_m)
    ]
    numbers = {p.number for p in large}
    rest = [p for p in pieces if p.number not in numbers]
    return [
        *_sentences(
            large, room.name, f"larger than the room of {room.size_m[0]:.1f} x {room.size_m[1]:.1f} m"
        ),
        *_sentences(
            [p for p in rest if p.role is FurnitureRole.PLANTING],
            room.name,
            "the edges of the garden are full",
        ),
        *_sentences([p for p in rest if p.role is not FurnitureRole.PLANTING], room.name, _IN_THE_WAY),
    ]


def _sentences(pieces: Sequence[FurniturePiece], room: str, reason: str) -> list[str]:
    counts = Counter(p.asset.asset_id for p in pieces)
    return [f"{count} {asset_id} in {room}: {reason}" for asset_id, count in counts.items()]
