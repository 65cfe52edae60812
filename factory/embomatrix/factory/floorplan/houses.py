"""Floor plans of house files: rooms at their written places, or packed so that every written door has its wall."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from embomatrix.factory.floorplan.doors import (
    USUAL_DOOR,
    YARDS_M,
    front_door,
    inner_doorway,
    outer_doorway,
)
from embomatrix.factory.floorplan.house_file import House, HouseDoor
from embomatrix.factory.floorplan.layout import (
    FINALISTS,
    WINDOW_COST_M2,
    FloorPlan,
    at_origin,
    plan_floor,
    with_walls,
)
from embomatrix.factory.floorplan.packing import Packing, pack
from embomatrix.factory.floorplan.spec import FloorPlanError, OpeningSpec, RoomSpec
from embomatrix.factory.floorplan.walls import Rect, WallCut, shared_edge
from embomatrix.world.scene import Doorway

TRIALS: Final = 400
"""Packings tried for one in which every door's rooms are neighbours."""
ENOUGH: Final = 20
"""Number of such packings after which no more are tried."""


def plan_house(house: House, rooms: Sequence[RoomSpec], rng: np.random.Generator) -> FloorPlan:
    """Return a floor plan with the rooms, doors and windows of a house. ``rooms`` have no doors of their own.

    Equal generator states give equal plans. Raises FloorPlanError if the doors leave no arrangement, or if the front door
    has no outer wall.
    """
    if house.rects:
        return with_walls(rooms, at_origin(house.rects), _doorways(house, rooms, at_origin(house.rects), rng))
    if not house.doors:
        return plan_floor(rooms, rng)
    listed = [_with_doors(room, house.doors) for room in rooms]
    plans = [
        (packing.score, with_walls(rooms, rects, _doorways(house, rooms, rects, rng)))
        for packing in _packings(house, listed, rng)
        for rects in (at_origin(packing.rects),)
    ]
    windows = sum(len(room.windows) for room in rooms)
    return min(plans, key=lambda pair: pair[0] + WINDOW_COST_M2 * (windows - len(pair[1].windows)))[1]


def _with_doors(room: RoomSpec, doors: Sequence[HouseDoor]) -> RoomSpec:
    """List the doors of a room under distinct names: the packing brings rooms that list the same door together."""
    mine = [
        OpeningSpec(f"door {number}", door.needs_m, USUAL_DOOR.height_m)
        for number, door in enumerate(doors)
        if room.name in door.rooms and door.rooms[1]
    ]
    return replace(room, doors=tuple(mine))


def _packings(house: House, rooms: Sequence[RoomSpec], rng: np.random.Generator) -> list[Packing]:
    """Return the most compact packings in which every door has its wall. Raise FloorPlanError if there is none."""
    found: list[Packing] = []
    missing: Counter[HouseDoor] = Counter()
    for _ in range(TRIALS):
        packing = pack(rooms, rng)
        if packing is None:
            continue
        without = [door for door in house.doors if not _has_wall(door, packing.rects)]
        missing.update(without)
        if not without:
            found.append(packing)
            if len(found) == ENOUGH:
                break
    if found:
        return sorted(found, key=lambda packing: packing.score)[:FINALISTS]
    worst = max(missing, key=lambda door: missing[door], default=None)
    between = " and ".join(name or "the outside" for name in worst.rooms) if worst is not None else ""
    reason = (
        f"the door between {between} most often has no wall" if worst is not None else "no room joins another"
    )
    raise FloorPlanError(
        f"no arrangement of the {len(rooms)} rooms gives every door its wall ({TRIALS} tried): {reason}; give each room "
        "its place with rect_m, or leave out a door"
    )


def _has_wall(door: HouseDoor, rects: Mapping[str, Rect]) -> bool:
    a, b = door.rooms
    if not b:
        return any(outer_doorway(a, USUAL_DOOR, rects, yard_m) is not None for yard_m in YARDS_M)
    edge = shared_edge(rects[a], rects[b])
    return edge is not None and edge.length >= door.needs_m


def _doorways(
    house: House, rooms: Sequence[RoomSpec], rects: Mapping[str, Rect], rng: np.random.Generator
) -> list[WallCut[Doorway]]:
    """Return the doorways of the house, the exterior one last. Raise FloorPlanError if it has no wall."""
    types = {room.name: room.type for room in rooms}
    cuts: list[WallCut[Doorway]] = []
    front: WallCut[Doorway] | None = None
    for door in house.doors:
        a, b = door.rooms
        opening = OpeningSpec("", door.width_m, USUAL_DOOR.height_m) if door.width_m else None
        if b:
            edge = shared_edge(rects[a], rects[b])
            if edge is None:
                raise FloorPlanError(f"rooms {a!r} and {b!r} share no wall: expected neighbours")
            cuts.append(inner_doorway((a, b), edge, opening, (types[a], types[b]), rng))
            continue
        fits = (outer_doorway(a, opening or USUAL_DOOR, rects, yard_m) for yard_m in YARDS_M)
        front = next((cut for cut in fits if cut is not None), None)
        if front is None:
            raise FloorPlanError(
                f"{a!r} has no outer wall for the front door: name another room in [[doors]]"
            )
    return [*cuts, front if front is not None else front_door(rooms, rects)]
