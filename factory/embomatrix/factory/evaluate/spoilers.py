"""Corruptions of hand-made rooms, against which the aesthetics score is fitted and tested.

Each changes the added objects only. The others stay where they are.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from embomatrix.factory.evaluate.room_plans import RoomBox, RoomPlan

SHIFT_M: Final = 0.4
TURN_RAD: Final = math.radians(15)
SWAPPED: Final = 0.7
"""Share of a room's small objects that change places."""
Move = tuple[float, float]
STILL: Final[Move] = (0.0, 0.0)


def shifted(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Move and turn each piece a little at random, together with its small objects."""
    moves = {at: (rng.normal(0.0, SHIFT_M), rng.normal(0.0, SHIFT_M)) for at in room.added_pieces}
    tilts = {at: rng.normal(0.0, TURN_RAD) for at in room.added_pieces}
    turned = [
        replace(_moved(item, moves.get(at, STILL)), tilt_rad=item.tilt_rad + tilts.get(at, 0.0))
        for at, item in enumerate(room.pieces)
    ]
    return replace(room, pieces=tuple(turned), things=_carried(room, moves))


def swapped(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Swap the places of small objects, independent of their hosts."""
    chosen = [at for at in room.added_things if rng.random() < SWAPPED]
    things, carried = list(room.things), list(room.carried)
    for at, other in zip(chosen, rng.permutation(chosen) if chosen else (), strict=True):
        things[at] = put_at(room.things[at], room.things[int(other)])
        carried[at] = room.carried[int(other)]
    return replace(room, things=tuple(things), carried=tuple(carried))


def put_at(thing: RoomBox, place: RoomBox) -> RoomBox:
    """Return the thing with its underside where another one has it."""
    high_m = place.low_m + thing.high_m - thing.low_m
    return replace(thing, center_m=place.center_m, low_m=place.low_m, high_m=high_m, host=place.host)


def dropped(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Put each piece anywhere in the room, perhaps turned by a quarter, together with its small objects."""
    moves: dict[int, Move] = {}
    pieces = list(room.pieces)
    for at in room.added_pieces:
        item = room.pieces[at]
        x, y = (rng.uniform(low, high) for low, high in zip(room.low_m, room.high_m, strict=True))
        moves[at] = (x - item.center_m[0], y - item.center_m[1])
        half_m = item.half_m[::-1] if rng.random() < 0.5 else item.half_m
        pieces[at] = replace(_moved(item, moves[at]), half_m=half_m)
    return replace(room, pieces=tuple(pieces), things=_carried(room, moves))


def scattered(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Put each small object at a random spot of its own host, at a random angle."""
    things = list(room.things)
    bearers = room.bearers
    for at in room.added_things:
        if room.carried[at]:
            host = bearers[room.carried[at][0]]
            thing = replace(things[at], tilt_rad=rng.uniform(-math.pi / 4, math.pi / 4))
            slack = [max(0.0, a - b) for a, b in zip(host.reach_m, thing.reach_m, strict=True)]
            x, y = (a + rng.uniform(-b, b) for a, b in zip(host.center_m, slack, strict=True))
            things[at] = replace(thing, center_m=(x, y))
    return replace(room, things=tuple(things))


Spoiler = Callable[[RoomPlan, np.random.Generator], RoomPlan]
SPOILERS: Final[Mapping[str, Spoiler]] = {
    "shifted": shifted,
    "swapped": swapped,
    "dropped": dropped,
    "scattered": scattered,
}


def _carried(room: RoomPlan, moves: Mapping[int, Move]) -> tuple[RoomBox, ...]:
    """Return the small objects, moved along with the pieces below them."""
    return tuple(
        _moved(thing, next((moves[host] for host in hosts if host in moves), STILL))
        for thing, hosts in zip(room.things, room.carried, strict=True)
    )


def _moved(item: RoomBox, move: Sequence[float]) -> RoomBox:
    return replace(item, center_m=(item.center_m[0] + move[0], item.center_m[1] + move[1]))
