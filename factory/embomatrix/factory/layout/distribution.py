"""Scene-level Distribution Agent: rules that assign each object of a task to a room, as in the paper.

The task's demands come first: objects that a relation ties together share a room. The rules then score room type,
furniture, size and the number of objects already assigned.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from embomatrix.factory.furnish.small_objects import belongs, is_usual_host, preferred_hosts
from embomatrix.factory.layout.values import (
    Distribution,
    DistributionBrief,
    LayoutRoomFacts,
    ObjectBrief,
    PlacementClass,
)

ROOM_TYPE_SCORE: Final = 1.0
"""Score of a room whose type suits the object."""
PREFERRED_HOST_SCORE: Final = 0.8
"""Score of a room that has the object's preferred furniture."""
NO_HOST_SCORE: Final = -5.0
"""Score of a room in which the object would have to lie on the floor."""
SIZE_SCORE: Final = 0.25
"""Score of a room that is e times as large as another."""
LOAD_PENALTY: Final = 0.15
"""Penalty for each object that the room already received."""
RANDOM_SCORE: Final = 0.3


class DistributionError(ValueError):
    """Brief that no distribution satisfies. The message names the object and the allowed rooms."""


def distribute(brief: DistributionBrief) -> Distribution:
    """Return a room for each object.

    Raise DistributionError if an object fits no room, or if demands contradict one another.
    """
    rooms = {room.name: room for room in brief.rooms}
    rng = np.random.default_rng((brief.seed, 5))
    given: Counter[str] = Counter()
    found: dict[str, str] = {}
    reasons: dict[str, str] = {}
    for family in tied_groups(brief.objects):
        allowed, why = _allowed(family, brief, rooms)
        scores = {
            name: _score(family, rooms[name], given[name]) + RANDOM_SCORE * float(rng.random())
            for name in allowed
        }
        room = max(scores, key=lambda name: (scores[name], name))
        given[room] += len(family)
        for item in family:
            found[item.name] = room
            reasons[item.name] = why or _reason_for(item, rooms[room])
    return Distribution(found, reasons)


def tied_groups(objects: Sequence[ObjectBrief]) -> list[tuple[ObjectBrief, ...]]:
    """Group the objects that the task's relations tie together, directly or indirectly. Each group shares a room."""
    leader = {item.name: item.name for item in objects}

    def head(name: str) -> str:
        while leader[name] != name:
            name = leader[name]
        return name

    anchors: dict[str, str] = {}
    for item in objects:
        for other in filter(None, (item.host, *item.beside)):
            # An existing object ties together all objects that the task puts at it.
            tied = other if other in leader else anchors.setdefault(other, item.name)
            leader[head(item.name)] = head(tied)
    grouped: dict[str, list[ObjectBrief]] = {}
    for item in objects:
        grouped.setdefault(head(item.name), []).append(item)
    return [tuple(group) for group in grouped.values()]


def _allowed(
    family: Sequence[ObjectBrief], brief: DistributionBrief, rooms: Mapping[str, LayoutRoomFacts]
) -> tuple[list[str], str]:
    """Return the rooms that all objects of the group may be in, and the reason if there is no choice."""
    names = {item.name for item in family}
    held = {
        rooms_of
        for item in family
        for other in filter(None, (item.host, *item.beside))
        if other not in names
        for rooms_of in (other if other in rooms else brief.homes.get(other, ""),)
    }
    allowed = [name for name in rooms if not held or held == {name}]
    for item in family:
        if item.rooms:
            allowed = [name for name in allowed if name in item.rooms]
    if not allowed:
        wanted = sorted(held | {room for item in family for room in item.rooms})
        raise DistributionError(
            f"{', '.join(sorted(names))} belong together but are demanded in {', '.join(wanted)}: expected one room of "
            f"{', '.join(rooms)}"
        )
    if held:
        return allowed, "same room as the object that the task puts it at"
    return allowed, "demanded by the task" if len(allowed) == 1 < len(rooms) else ""


def _score(family: Sequence[ObjectBrief], room: LayoutRoomFacts, given: int) -> float:
    liking = sum(
        ROOM_TYPE_SCORE * belongs(item.category, room.type) + PREFERRED_HOST_SCORE * _host_score(item, room)
        for item in family
    )
    return liking / len(family) + SIZE_SCORE * math.log(max(room.area_m2, 1.0)) - LOAD_PENALTY * given


def _host_score(item: ObjectBrief, room: LayoutRoomFacts) -> float:
    """Score from 0 to 1 for the object's preferred hosts in the room; negative if the room has no host for it."""
    if item.kind is not PlacementClass.GOODS:
        return 0.5
    here = set(room.furniture)
    if not any(is_usual_host(host, item.category) for host in here):
        return NO_HOST_SCORE
    wanted = preferred_hosts(item.category)
    return max((1.0 - rank / len(wanted) for rank, host in enumerate(wanted) if host in here), default=0.2)


def _reason_for(item: ObjectBrief, room: LayoutRoomFacts) -> str:
    liked = next((host for host in preferred_hosts(item.category) if host in room.furniture), "")
    if liked:
        return f"{room.name} has a {liked}"
    if belongs(item.category, room.type):
        return f"such objects belong in a {room.type}"
    return f"{room.name} has space: {room.area_m2:.0f} m2"
