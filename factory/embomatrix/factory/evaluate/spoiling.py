"""Rooms made worse on purpose, to teach a score what bad is: furniture shifted, things swapped, furniture dropped anywhere."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from embomatrix.factory.evaluate.rooms import RoomBox, RoomPlan

SHIFT_M: Final = 0.4
TURN_RAD: Final = math.radians(15)
SWAPPED: Final = 0.7
"""Share of a room's small things that change places."""


def shifted(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Each piece moved and turned a little at random, what it bears with it."""
    moves = [tuple(float(step) for step in rng.normal(0.0, SHIFT_M, 2)) for _ in room.pieces]
    turned = [
        replace(_moved(item, move), tilt_rad=item.tilt_rad + float(rng.normal(0.0, TURN_RAD)))
        for item, move in zip(room.pieces, moves, strict=True)
    ]
    return replace(room, pieces=tuple(turned), things=_carried(room, moves))


def swapped(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Small things put where others were, whatever bears those."""
    chosen = [at for at in range(len(room.things)) if rng.random() < SWAPPED]
    things, carried = list(room.things), list(room.carried)
    for at, other in zip(chosen, rng.permutation(chosen) if chosen else (), strict=True):
        place, thing = room.things[int(other)], room.things[at]
        things[at] = replace(
            thing,
            center_m=place.center_m,
            low_m=place.low_m,
            high_m=place.low_m + thing.high_m - thing.low_m,
            host=place.host,
        )
        carried[at] = room.carried[int(other)]
    return replace(room, things=tuple(things), carried=tuple(carried))


def dropped(room: RoomPlan, rng: np.random.Generator) -> RoomPlan:
    """Each piece somewhere in the room, turned by a quarter or not, what it bears with it."""
    moves = []
    for item in room.pieces:
        x, y = (float(rng.uniform(low, high)) for low, high in zip(room.low_m, room.high_m, strict=True))
        moves.append((x - item.center_m[0], y - item.center_m[1]))
    pieces = [
        replace(_moved(item, move), half_m=item.half_m[::-1] if rng.random() < 0.5 else item.half_m)
        for item, move in zip(room.pieces, moves, strict=True)
    ]
    return replace(room, pieces=tuple(pieces), things=_carried(room, moves))


SPOILERS: Final = {"shifted": shifted, "swapped": swapped, "dropped": dropped}


def _carried(room: RoomPlan, moves: Sequence[tuple[float, ...]]) -> tuple[RoomBox, ...]:
    return tuple(
        _moved(thing, moves[bearer]) if bearer >= 0 else thing
        for thing, bearer in zip(room.things, room.carried, strict=True)
    )


def _moved(item: RoomBox, move: tuple[float, ...]) -> RoomBox:
    return replace(item, center_m=(item.center_m[0] + move[0], item.center_m[1] + move[1]))
