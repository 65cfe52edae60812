"""Scene-level Distribution Agent: which room each of a task's objects goes to, by rules as in the paper.

What the task says comes first: objects that are in a relation to one another are in one room, with the room of what is there
already. Then the room's function, its furniture, its size, and how much it was given so far decide.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.furnish.small_objects import belongs, is_usual_host, preferred_hosts
from embomatrix.factory.layout.values import Distribution, PlacementClass

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.factory.layout.values import DistributionBrief, LayoutRoomFacts, ObjectBrief

FUNCTION: Final = 1.0
"""What it is worth that a room of such a type is where people keep the thing."""
HOST: Final = 0.8
"""What the thing's favourite furniture is worth, where the room has it."""
BARE: Final = -5.0
"""Of a room where it would have to lie on the floor."""
SIZE: Final = 0.25
"""What a room is worth that is e times as large as another."""
CROWD: Final = 0.15
"""What each thing costs that a room was given already."""
CHANCE: Final = 0.3


class DistributionError(ValueError):
    """A brief that no distribution fits; the sentence names the thing and what it may be."""


def distribute(brief: DistributionBrief) -> Distribution:
    """A room for each thing. Raises DistributionError where a thing may be in none of the rooms, or in two at once."""
    rooms = {room.name: room for room in brief.rooms}
    rng = np.random.default_rng((brief.seed, 5))
    given: Counter[str] = Counter()
    found: dict[str, str] = {}
    reasons: dict[str, str] = {}
    for family in families(brief.objects):
        allowed, why = _allowed(family, brief, rooms)
        scores = {
            name: _score(family, rooms[name], given[name]) + CHANCE * float(rng.random()) for name in allowed
        }
        room = max(scores, key=lambda name: (scores[name], name))
        given[room] += len(family)
        for thing in family:
            found[thing.name] = room
            reasons[thing.name] = why or _because(thing, rooms[room])
    return Distribution(found, reasons)


def families(objects: Sequence[ObjectBrief]) -> list[tuple[ObjectBrief, ...]]:
    """Things grouped by the relations that the task puts them in, directly or through others: each group in one room."""
    leader = {thing.name: thing.name for thing in objects}

    def head(name: str) -> str:
        while leader[name] != name:
            name = leader[name]
        return name

    anchors: dict[str, str] = {}
    for thing in objects:
        for other in filter(None, (thing.host, *thing.beside)):
            # what is there already ties together all that the task puts at it
            tied = other if other in leader else anchors.setdefault(other, thing.name)
            leader[head(thing.name)] = head(tied)
    grouped: dict[str, list[ObjectBrief]] = {}
    for thing in objects:
        grouped.setdefault(head(thing.name), []).append(thing)
    return [tuple(group) for group in grouped.values()]


def _allowed(
    family: Sequence[ObjectBrief], brief: DistributionBrief, rooms: Mapping[str, LayoutRoomFacts]
) -> tuple[list[str], str]:
    """Rooms that all of the family may be in, and why there is no choice where there is none."""
    names = {thing.name for thing in family}
    held = {
        rooms_of
        for thing in family
        for other in filter(None, (thing.host, *thing.beside))
        if other not in names
        for rooms_of in (other if other in rooms else brief.homes.get(other, ""),)
    }
    allowed = [name for name in rooms if not held or held == {name}]
    for thing in family:
        if thing.rooms:
            allowed = [name for name in allowed if name in thing.rooms]
    if not allowed:
        wanted = sorted(held | {room for thing in family for room in thing.rooms})
        raise DistributionError(
            f"{', '.join(sorted(names))} belong together and are wanted in {', '.join(wanted)}: name one room of "
            f"{', '.join(rooms)}"
        )
    if held:
        return allowed, "with what the task puts it at"
    return allowed, "as the task says" if len(allowed) == 1 < len(rooms) else ""


def _score(family: Sequence[ObjectBrief], room: LayoutRoomFacts, given: int) -> float:
    liking = sum(
        FUNCTION * belongs(thing.category, room.type) + HOST * _welcome(thing, room) for thing in family
    )
    return liking / len(family) + SIZE * math.log(max(room.area_m2, 1.0)) - CROWD * given


def _welcome(thing: ObjectBrief, room: LayoutRoomFacts) -> float:
    """How much of what the thing likes to stand on or in the room has, from 0 to 1; less where it has nothing at all."""
    if thing.kind is not PlacementClass.GOODS:
        return 0.5
    here = set(room.furniture)
    if not any(is_usual_host(host, thing.category) for host in here):
        return BARE
    wanted = preferred_hosts(thing.category)
    return max((1.0 - rank / len(wanted) for rank, host in enumerate(wanted) if host in here), default=0.2)


def _because(thing: ObjectBrief, room: LayoutRoomFacts) -> str:
    liked = next((host for host in preferred_hosts(thing.category) if host in room.furniture), "")
    if liked:
        return f"{room.name} has a {liked}"
    if belongs(thing.category, room.type):
        return f"such objects belong in a {room.type}"
    return f"{room.name} has room: {room.area_m2:.0f} m2"
