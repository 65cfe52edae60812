"""Furnishing of a floor plan: the inventory of every room, placed so that the robot can reach everything it may use."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from embomatrix.factory.floorplan.ceilings import HEAD_ROOM_M
from embomatrix.factory.floorplan.layout import FloorPlan
from embomatrix.factory.floorplan.spec import OUTDOORS
from embomatrix.factory.furnish.groups import alone, in_the_open, room_groups
from embomatrix.factory.furnish.halls import mat_rows
from embomatrix.factory.furnish.hung import ceiling_groups, hung_groups, rug_groups
from embomatrix.factory.furnish.pieces import FurnitureGroup, FurniturePiece, Member, Placed, Pool, Rows
from embomatrix.factory.furnish.roles import FurnitureRole, importance_of
from embomatrix.factory.furnish.rugs import lay_rugs
from embomatrix.factory.furnish.solver import RoomSolver, lay_rows
from embomatrix.factory.furnish.space import Box, RoomSpace
from embomatrix.factory.furnish.surfaces import SurfacePlacer
from embomatrix.factory.furnish.tables import STOOLS
from embomatrix.factory.furnish.worktops import side_panels
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import ConvexPart, Pose, Shape
from embomatrix.world.scene import Room

ATTEMPTS: Final = 24
CROWDED_ATTEMPTS: Final = 6
"""Arrangements tried before one that leaves something out is accepted; fewer for rooms with many pieces."""
CROWD: Final = 30
HALL: Final = 90
"""A room with more pieces than this is arranged at most twice."""
GOOD_ENOUGH: Final = 2.0
"""After CROWDED_ATTEMPTS, an arrangement that leaves out no more importance than this is accepted: a trash can, a picture."""
_IN_THE_WAY: Final = "no free place keeps the room passable"
MAX_EQUAL: Final = 6
"""Upper limit for small objects and lights of one model in a room: the diner's kitchen lists 137 trays."""
MAX_FURNITURE: Final = 60
MAX_SEATS: Final = 120
MAX_PLANTS: Final = 24
"""Upper limit for plants of one model: a wood is represented by this many."""
_CAPS: Final[Mapping[FurnitureRole, int]] = {
    FurnitureRole.SURFACE: MAX_EQUAL,
    FurnitureRole.CEILING: MAX_EQUAL,
    FurnitureRole.SEAT: MAX_SEATS,
    FurnitureRole.PLANTING: MAX_PLANTS,
}
_ABOVE_FLOOR_M: Final = 0.1
_RUG_WOBBLE: Final = 0.4
_PAST_M: Final = 2 * ROBOT.radius_m + 0.1
_LIGHT_LOSSES: Final = frozenset(
    (FurnitureRole.WALL, FurnitureRole.CEILING, FurnitureRole.RUG, FurnitureRole.PLANTING)
)
"""Roles whose loss does not trigger a new arrangement, unless the piece is essential to the room, like a basin."""
_WEIGHTY: Final = 10.0


@dataclass(frozen=True, slots=True)
class Furnishing:
    """Placed pieces of a whole plan, with hosts as indices into ``placed``, and a sentence for each model left out."""

    placed: tuple[Placed, ...]
    left_out: tuple[str, ...]
    panels: tuple[ConvexPart, ...] = ()
    """Side panels of worktops without cabinets; they belong to the building."""
    loss: float = 0.0
    """Summed importance of the pieces without a place on floor, walls and ceilings."""


@dataclass(frozen=True, slots=True)
class _Arrangement:
    solver: RoomSolver
    dropped: tuple[FurniturePiece, ...]
    unfit: tuple[tuple[FurniturePiece, str], ...]
    """Pieces that no group takes, with the reason."""

    @property
    def loss(self) -> float:
        return sum(importance_of(p.category, p.role) for p in self.dropped)


def furnish(plan: FloorPlan, pieces: dict[str, list[FurniturePiece]], rng: np.random.Generator) -> Furnishing:
    """Place the pieces of every room of the plan; ``pieces`` maps room names to their inventories.

    Equal generator states give equal results. ``left_out`` names every piece without a place.
    """
    placed: list[Placed] = []
    left_out: list[str] = []
    small: list[tuple[str, FurniturePiece]] = []
    loss = 0.0
    pieces = _moved(plan, pieces)
    for room in plan.rooms:
        wanted, notes = _capped(pieces.get(room.name, []), room)
        best = _with_rugs(_best_arrangement(room, plan, wanted, rng), wanted, rng)
        start = len(placed)
        loss += best.loss
        placed += [replace(p, host=p.host + start) if p.host >= 0 else p for p in best.solver.placed]
        unplaced = _with_reasons(best.dropped, room)
        left_out += [*notes, *_sentences(best.unfit, room.name), *_sentences(unplaced, room.name)]
        done = {p.piece.number for p in best.solver.placed} | {p.number for p in best.dropped}
        small += [(room.name, p) for p in wanted if p.role is FurnitureRole.SURFACE and p.number not in done]
    left_out += _set_small_things(plan, placed, small, rng)
    panels = tuple(_solid(box) for item in placed for box in side_panels(item))
    return Furnishing(tuple(placed), tuple(left_out), panels, loss)


def _solid(box: Box) -> ConvexPart:
    x0, y0, z0, x1, y1, z1 = box
    middle = ((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2)
    return ConvexPart(Shape.BOX, Pose(middle), (x1 - x0, y1 - y0, z1 - z0))


def _moved(
    plan: FloorPlan, pieces: Mapping[str, Sequence[FurniturePiece]]
) -> dict[str, list[FurniturePiece]]:
    """Return the inventories; a bar too large for its room moves to a neighbouring room together with its stools."""
    rooms = {room.name: room for room in plan.rooms}
    moved: dict[str, list[FurniturePiece]] = {name: [] for name in rooms}
    for name, mine in pieces.items():
        beside = _neighbours(plan, name)
        large = [p for p in mine if p.category == "bar" and not _has_room(p, rooms[name])]
        home = next((other for other in beside if large and _has_room(large[0], rooms[other])), name)
        for piece in mine:
            goes = any(piece is bar for bar in large) or (bool(large) and piece.category in STOOLS)
            moved[home if goes else name].append(piece)
    return moved


def _has_room(piece: FurniturePiece, room: Room) -> bool:
    """True if the robot can pass the piece when it stands at a wall."""
    short, long = sorted(piece.size_m[:2])
    return short + _PAST_M <= min(room.size_m) and long <= max(room.size_m)


def _capped(pieces: Sequence[FurniturePiece], room: Room) -> tuple[list[FurniturePiece], list[str]]:
    """Return as many pieces of each model as `_CAPS` allows, those in their place only; and sentences on the rest."""
    kept: list[FurniturePiece] = []
    totals = Counter(p.asset.asset_id for p in pieces)
    seen: Counter[str] = Counter()
    for piece in pieces:
        seen[piece.asset.asset_id] += 1
        most = _CAPS.get(piece.role, MAX_FURNITURE)
        if not _out_of_place(piece, room) and seen[piece.asset.asset_id] <= most:
            kept.append(piece)
    notes = []
    for piece in {p.asset.asset_id: p for p in pieces}.values():
        asset_id, total = piece.asset.asset_id, totals[piece.asset.asset_id]
        most = _CAPS.get(piece.role, MAX_FURNITURE)
        if reason := _out_of_place(piece, room):
            notes.append(f"{total} {asset_id} in {room.name}: {reason}")
        elif total > most:
            notes.append(
                f"{total - most} of {total} {asset_id} in {room.name}: at most {most} of a model in a room"
            )
    return kept, notes


def _out_of_place(piece: FurniturePiece, room: Room) -> str:
    """Return the reason for which no room, or not this one, can hold the piece; "" if it can."""
    outdoors = room.type in OUTDOORS
    match piece.role:
        case FurnitureRole.STRUCTURE:
            return "part of the building, which floor and walls stand for"
        case FurnitureRole.PLANTING if not outdoors:
            return "it grows outdoors, and the room is indoors"
        case FurnitureRole.CEILING if outdoors:
            return "it hangs from a ceiling, and a garden has none"
        case FurnitureRole.CEILING if piece.size_m[2] > room.height_m - HEAD_ROOM_M:
            return "it would hang into the way of people's heads"
        case FurnitureRole.WALL if piece.size_m[2] > room.height_m - _ABOVE_FLOOR_M:
            return "it hangs, and is higher than the room"
    return ""


def _best_arrangement(
    room: Room, plan: FloorPlan, pieces: Sequence[FurniturePiece], rng: np.random.Generator
) -> _Arrangement:
    tried: list[_Arrangement] = []
    first: set[int] = set()
    standing = sum(p.role not in (FurnitureRole.SURFACE, FurnitureRole.PLANTING) for p in pieces)
    attempts = ATTEMPTS if standing < CROWD else CROWDED_ATTEMPTS if standing < HALL else 2
    for attempt in range(attempts):
        tried.append(_arrange(room, plan, pieces, rng, first, wobble=0.4 + 0.2 * attempt))
        # Pieces without a place are placed first in the next attempt.
        lost = [p for p in tried[-1].dropped if _matters(p)]
        first |= {p.number for p in lost}
        if not lost or (attempt >= CROWDED_ATTEMPTS and min(a.loss for a in tried) <= GOOD_ENOUGH):
            break
    return min(tried, key=lambda arrangement: arrangement.loss)


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
    groups, unfit = room_groups(pieces, room)
    groups.sort(key=lambda g: all(m.piece.number not in first for m in _members(g)))
    dropped = _place_all(solver, groups, wobble, rng)
    # Pieces dropped from a group may still find a place alone: a chair at the wall, an armchair in the corner.
    dropped = _place_all(solver, [alone(p) for p in dropped], wobble, rng)
    walls = [p for p in dropped if in_the_open(p) is None]
    dropped = walls + _place_all(solver, [g for p in dropped if (g := in_the_open(p))], wobble, rng)
    taken = {p.piece.number for p in solver.placed} | {p.number for p in dropped}
    rest = [p for p in pieces if p.number not in taken]
    hung = (*hung_groups(rest, room.height_m), *ceiling_groups(rest, room.height_m))
    dropped += _place_all(solver, hung, wobble, rng)
    return _Arrangement(solver, tuple(dropped), tuple(unfit))


def _with_rugs(
    best: _Arrangement, pieces: Iterable[FurniturePiece], rng: np.random.Generator
) -> _Arrangement:
    """Lay mats in rows, rugs under furniture, and the rest on free floor of the arrangement that was chosen."""
    pool = Pool(p for p in pieces if p.role is FurnitureRole.RUG)
    dropped = _place_all(best.solver, mat_rows(pool), _RUG_WOBBLE, rng)
    rugs = lay_rugs(best.solver, pool.take(pool.of("carpet")))
    dropped += _place_all(best.solver, rug_groups([*rugs, *pool.rest]), _RUG_WOBBLE, rng)
    return replace(best, dropped=(*best.dropped, *dropped))


def _place_all(
    solver: RoomSolver, groups: Iterable[FurnitureGroup | Rows], wobble: float, rng: np.random.Generator
) -> list[FurniturePiece]:
    """Place group after group; return the pieces without a place."""
    dropped: list[FurniturePiece] = []
    hopeless: set[tuple[str, ...]] = set()
    for item in groups:
        for group in lay_rows(solver, item, wobble, rng) if isinstance(item, Rows) else (item,):
            remaining = group
            while _signature(remaining) in hopeless or not solver.place(remaining, wobble=wobble):
                # An equal group finds no place later: the room only gets fuller.
                hopeless.add(_signature(remaining))
                dropped.append(remaining.members[-1].piece)
                if len(remaining.members) == 1:
                    break
                # The last member is the least important: a chair, a stool, the coffee table.
                remaining = replace(remaining, members=remaining.members[:-1])
    return dropped


def _matters(piece: FurniturePiece) -> bool:
    """True if losing the piece triggers a new arrangement of the room."""
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
    """Put small objects on and in the furniture of their room, else of a neighbouring room."""
    placer = SurfacePlacer(placed, rng)
    beside = {room.name: _neighbours(plan, room.name) for room in plan.rooms}
    dropped: dict[str, list[tuple[FurniturePiece, str]]] = {}
    for room, piece in sorted(small, key=lambda item: -item[1].size_m[0] * item[1].size_m[1]):
        if not placer.place(piece, (room, *beside[room])):
            dropped.setdefault(room, []).append((piece, "no surface has room for it"))
    return [sentence for room, refused in dropped.items() for sentence in _sentences(refused, room)]


def _neighbours(plan: FloorPlan, room: str) -> list[str]:
    """Return the rooms that share a doorway with this one."""
    inner = (doorway.rooms for doorway in plan.doorways if room in doorway.rooms and doorway.rooms[1])
    return [b if a == room else a for a, b in inner]


def _with_reasons(pieces: Sequence[FurniturePiece], room: Room) -> list[tuple[FurniturePiece, str]]:
    """Return pieces without a place on floor or walls, with the reason: larger than the room first, then plants."""
    too_large = f"larger than the room of {room.size_m[0]:.1f} x {room.size_m[1]:.1f} m"
    reasons = (too_large, "the edges of the garden are full", _IN_THE_WAY)

    def rank(piece: FurniturePiece) -> int:
        short, long = sorted(piece.size_m[:2])
        if long > max(room.size_m) or short > min(room.size_m):
            return 0
        return 1 if piece.role is FurnitureRole.PLANTING else 2

    return [(piece, reasons[rank(piece)]) for piece in sorted(pieces, key=rank)]


def _sentences(refused: Sequence[tuple[FurniturePiece, str]], room: str) -> list[str]:
    """Return a sentence for each reason and model, those of one reason together."""
    counts = Counter((reason, piece.asset.asset_id) for piece, reason in refused)
    reasons = dict.fromkeys(reason for _, reason in refused)
    return [
        f"{count} {asset_id} in {room}: {reason}"
        for reason in reasons
        for (why, asset_id), count in counts.items()
        if why == reason
    ]
