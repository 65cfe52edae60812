"""Floor plans: the floor rectangles of a house, packed edge to edge and joined by doorways.

Every room is packed as its floor grown by half a wall on each side, so neighbouring floors lie exactly one wall apart. The
best of many seeded trials of slot packing wins.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.factory.floorplan.doors import place_doorways
from embomatrix.factory.floorplan.packing import Packing, pack
from embomatrix.factory.floorplan.spec import MIN_DOOR_M, FloorPlanError, RoomSpec
from embomatrix.factory.floorplan.walls import WALL_M, Rect, WallCut, build_walls
from embomatrix.factory.floorplan.windows import place_windows
from embomatrix.world.geometry import ConvexPart
from embomatrix.world.scene import Doorway, Room, Window

TRIALS: Final = 80
FINALISTS: Final = 6
"""Best packings that get doors and windows before one is chosen."""
WINDOW_COST_M2: Final = 3.0
"""Cost of a window without a wall, in square metres of extent."""


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Rooms, walls, doorways and windows, and a sentence for each listed door or window without a place.

    The last doorway leads outside. Its closed panel, like the panes of windows, is part of ``walls``.
    """

    rooms: tuple[Room, ...]
    walls: tuple[ConvexPart, ...]
    doorways: tuple[Doorway, ...]
    windows: tuple[Window, ...] = ()
    left_out: tuple[str, ...] = ()


def compactness(rooms: Sequence[Room]) -> float:
    """Return the share of the rooms' bounding box that is floor or wall, in (0, 1]."""
    low = np.min([r.low_m for r in rooms], axis=0) - WALL_M / 2
    high = np.max([r.high_m for r in rooms], axis=0) + WALL_M / 2
    used = sum((r.size_m[0] + WALL_M) * (r.size_m[1] + WALL_M) for r in rooms)
    return float(used / np.prod(high - low))


def plan_floor(rooms: Sequence[RoomSpec], rng: np.random.Generator, *, trials: int = TRIALS) -> FloorPlan:
    """Pack the rooms, connect all of them by doorways, and build the walls.

    Equal generator states give equal plans. Raises FloorPlanError if there are no rooms or they can't be joined by doors.
    """
    if not rooms:
        raise FloorPlanError("no rooms to pack: expected at least one")
    packings = [p for p in (pack(rooms, rng) for _ in range(trials)) if p is not None]
    if not packings:
        raise FloorPlanError(
            f"{len(rooms)} rooms found no joint plan in {trials} trials: every room needs a side of at least {MIN_DOOR_M} m"
        )
    finished = [
        _finish(rooms, packing, rng) for packing in sorted(packings, key=lambda p: p.score)[:FINALISTS]
    ]
    return min(finished, key=lambda pair: pair[0])[1]


def _finish(rooms: Sequence[RoomSpec], packing: Packing, rng: np.random.Generator) -> tuple[float, FloorPlan]:
    """Add doorways, windows and walls to a packing; return its score, windows without a wall included, and the plan."""
    rects = at_origin(packing.rects)
    doors, unused = place_doorways(rooms, rects, packing.parents, rng)
    plan = with_walls(rooms, rects, doors, unused)
    listed = sum(len(room.windows) for room in rooms)
    return packing.score + WINDOW_COST_M2 * (listed - len(plan.windows)), plan


def at_origin(rects: Mapping[str, Rect]) -> dict[str, Rect]:
    """Move the rooms together so that their bounding box begins at (0, 0)."""
    low = np.min([*rects.values()], axis=0)
    return {name: rect.moved(-float(low[0]), -float(low[1])) for name, rect in rects.items()}


def with_walls(
    rooms: Sequence[RoomSpec],
    rects: Mapping[str, Rect],
    doors: Sequence[WallCut[Doorway]],
    unused: Sequence[str] = (),
) -> FloorPlan:
    """Add windows and walls to placed rooms. ``unused`` are sentences on doors without a place."""
    panes, walled_up = place_windows(rooms, rects, doors)
    return FloorPlan(
        rooms=tuple(Room(s.name, s.type, *rects[s.name].floor, s.height_m) for s in rooms),
        walls=build_walls(rects, doors, panes, {s.name: s.height_m for s in rooms}),
        doorways=tuple(cut.opening for cut in doors),
        windows=tuple(cut.opening for cut in panes),
        left_out=(*unused, *walled_up),
    )
