"""Doorways of a floor plan: one from each room to the room it is entered from, and more if the inventory lists them."""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from embomatrix.factory.floorplan.spec import (
    ENTRANCES,
    MAX_DOOR_HEIGHT_M,
    MIN_DOOR_M,
    OPEN_PASSAGE_M,
    OPEN_PLAN,
    PRIVATE,
    SLEEPING,
    FloorPlanError,
    OpeningSpec,
    RoomSpec,
)
from embomatrix.factory.floorplan.walls import Edge, Rect, WallCut, shared_edge
from embomatrix.world.scene import Doorway

YARDS_M: Final = (3.0, 0.5)
"""Free ground before the front door, so that it does not open into a gap between two rooms; the preferred depth first."""
USUAL_DOOR: Final = OpeningSpec("", 0.9, 2.05)


def place_doorways(
    rooms: Sequence[RoomSpec], rects: Mapping[str, Rect], parents: Mapping[str, str], rng: np.random.Generator
) -> tuple[list[WallCut[Doorway]], list[str]]:
    """Return doorways that join all rooms, the exterior one last, and a sentence on listed doors without a place."""
    left = {r.name: list(r.doors) for r in rooms}
    types = {r.name: r.type for r in rooms}
    front = front_door(rooms, rects)
    if front.opening.model:
        room = front.opening.rooms[0]
        left[room].remove(next(d for d in left[room] if d.model == front.opening.model))
    # Pairs that list the same door come first: otherwise a third room could use it.
    pairs = sorted(
        parents.items(), key=lambda p: not {d.model for d in left[p[0]]} & {d.model for d in left[p[1]]}
    )
    cuts = [_join(child, parent, rects, left, types, rng) for child, parent in pairs]
    joined = {frozenset(pair) for pair in parents.items()}
    for a, b in itertools.combinations([r.name for r in rooms], 2):
        shared = {d.model for d in left[a]} & {d.model for d in left[b]}
        edge = shared_edge(rects[a], rects[b])
        if shared and frozenset((a, b)) not in joined and edge and edge.length >= MIN_DOOR_M + 0.2:
            cuts.append(_join(a, b, rects, left, types, rng))
    unused = Counter((room, door.model) for room, doors in left.items() for door in doors)
    notes = [
        f"{n} door-{model} in {room}: no neighbour is left to join" for (room, model), n in unused.items()
    ]
    return [*cuts, front], notes


def _join(
    a: str,
    b: str,
    rects: Mapping[str, Rect],
    left: Mapping[str, list[OpeningSpec]],
    types: Mapping[str, str],
    rng: np.random.Generator,
) -> WallCut[Doorway]:
    """Return a doorway between two neighbours and remove its door from the rooms' lists in ``left``."""
    edge = shared_edge(rects[a], rects[b])
    if edge is None:
        raise FloorPlanError(f"rooms {a!r} and {b!r} share no wall: expected neighbours")
    return inner_doorway((a, b), edge, _take_door(left[a], left[b]), (types[a], types[b]), rng)


def inner_doorway(
    rooms: tuple[str, str],
    edge: Edge,
    door: OpeningSpec | None,
    types: tuple[str, str],
    rng: np.random.Generator,
) -> WallCut[Doorway]:
    """Return a doorway in the wall ``edge`` between two rooms of these types; without a door it has the usual size."""
    if door is not None:
        width, height = door.width_m, door.height_m
    elif types[0] in OPEN_PLAN and types[1] in OPEN_PLAN:
        # Short walls keep the depth of a counter on either side of the passage.
        width, height = min(OPEN_PASSAGE_M, max(MIN_DOOR_M, edge.length - 1.4)), MAX_DOOR_HEIGHT_M
    else:
        width, height = USUAL_DOOR.width_m, USUAL_DOOR.height_m
    width = min(max(width, MIN_DOOR_M), edge.length)
    slack = edge.length - width
    # Doors are near a corner, which leaves long walls; wide passages may also be in the middle.
    ends = (
        (slack / 2,) if slack < 0.5 else (0.2, slack - 0.2) if width <= 1.2 else (0.1, slack / 2, slack - 0.1)
    )
    start = edge.start + float(rng.choice(ends))
    return edge.doorway(rooms, start, width, min(height, MAX_DOOR_HEIGHT_M), door.model if door else "")


def _take_door(a: list[OpeningSpec], b: list[OpeningSpec]) -> OpeningSpec | None:
    """Remove and return the door that both rooms list, else the first door of either."""
    both = [d for d in a if d in b]
    if both:
        a.remove(both[0])
        b.remove(both[0])
        return both[0]
    return a.pop(0) if a else b.pop(0) if b else None


def front_door(rooms: Sequence[RoomSpec], rects: Mapping[str, Rect]) -> WallCut[Doorway]:
    """Return the exterior door, in the most public room with enough outer wall.

    A door listed by a single room is an exterior one: a public room with such a door comes first. A house without public
    rooms, such as a hotel suite, is entered through the bedroom.
    """
    listed = Counter(model for r in rooms for model in {d.model for d in r.doors})
    public = [kind for kind in ENTRANCES if any(r.type == kind for r in rooms)] or list(SLEEPING)

    def own_doors(room: RoomSpec) -> list[OpeningSpec]:
        return [d for d in room.doors if listed[d.model] == 1 and room.type in public]

    def order(room: RoomSpec) -> tuple[bool, int]:
        rank = public.index(room.type) if room.type in public else len(public) + (room.type in PRIVATE)
        return (not own_doors(room), rank)

    for yard_m in YARDS_M:
        for room in sorted(rooms, key=order):
            door = max(own_doors(room), key=lambda d: d.width_m, default=USUAL_DOOR)
            if (cut := outer_doorway(room.name, door, rects, yard_m)) is not None:
                return cut
    raise FloorPlanError("no room has an outer wall wide enough for a front door")


def outer_doorway(
    room: str, door: OpeningSpec, rects: Mapping[str, Rect], yard_m: float
) -> WallCut[Doorway] | None:
    """Return a door to the outside in the longest outer wall of a room with ``yard_m`` of free ground before it, if any."""
    others = [rect for name, rect in rects.items() if name != room]
    edge = max(rects[room].outer_edges(others, yard_m), key=lambda e: e.length, default=None)
    if edge is None or edge.length < MIN_DOOR_M + 0.1:
        return None
    width = min(max(door.width_m, MIN_DOOR_M), edge.length - 0.1)
    start = edge.start + (edge.length - width) / 2
    return edge.doorway((room, ""), start, width, min(door.height_m, MAX_DOOR_HEIGHT_M), door.model)
