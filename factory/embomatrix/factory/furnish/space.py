"""A room while it is being furnished: solids, keep-out zones and the floor that the robot can still reach."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy import ndimage

from embomatrix.factory.floorplan.walls import WALL_M
from embomatrix.factory.furnish.boxes import BoxStack, Planes
from embomatrix.skills.limits import ROBOT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from embomatrix.factory.furnish.boxes import BoolArray, Box, FloatArray
    from embomatrix.world.scene import Doorway, Room, Window

CELL_M: Final = 0.05
DOOR_CLEAR_M: Final = 0.8
DOOR_HEIGHT_M: Final = 2.1
WINDOW_CLEAR_M: Final = 0.5
WINDOW_FROM_M: Final = 0.9
"""What is no higher than this may stand before a window, however low its sill: a sofa, a desk, a counter."""
LOW_M: Final = 0.03
"""What is no higher than this is floor to the robot: a rug."""
_MARGIN_M: Final = 0.3
_BASE_CLEAR_M: Final = ROBOT.radius_m + 0.01
_HALF: Final = CELL_M / 2
_KEEP_CELLS: Final = (_BASE_CLEAR_M + _HALF) / CELL_M
"""The base stands nowhere closer than this many cells to a cell that something touches."""
_RING: Final = math.ceil(_KEEP_CELLS)
_AROUND: Final = 2
_ISLAND_CELLS: Final = round(0.5 / CELL_M**2)
"""Half a square metre: more floor that the base fits on is not cut off from the doorways."""

_Cell = tuple[int, int]
_Cells = tuple[int, int, int, int]
"""(i0, i1, j0, j1): a window of cells."""


@dataclass(frozen=True, slots=True)
class Target:
    """A strip of floor, (x0, y0, x1, y1), that must hold a spot where the robot can stand."""

    strip: tuple[float, float, float, float]


class RoomSpace:
    """Occupancy of one room. Boxes are axis-aligned: everything on the floor stands at quarter turns.

    The floor that the robot can reach is kept up to date box by box: a new one changes only the cells around it.
    """

    def __init__(self, room: Room, doorways: Sequence[Doorway], windows: Sequence[Window] = ()) -> None:
        self.room = room
        self.doorways = tuple(d for d in doorways if room.name in d.rooms)
        self.solids = BoxStack()
        self.zones = BoxStack([self._door_zone(d) for d in self.doorways])
        self.windows = tuple(w for w in windows if room.name in w.rooms)
        self.zones.extend([self._window_zone(w) for w in self.windows])
        self._origin, self._shape = _grid_of(room)
        self._targets: list[_Cells] = []
        stand, reach, self._doors = _bare_floor(room, self.doorways)
        self._stand, self._reach = stand.copy(), reach.copy()
        self._joined = bool(self._doors) and all(reach[cell] for cell in self._doors)
        self.fronts = BoxStack()
        self._planes = Planes(room.low_m, room.high_m, (self.solids, self.zones, self.fronts))
        self._hung_planes = Planes(room.low_m, room.high_m, (self.solids, self.zones))
        self._solid_planes = Planes(room.low_m, room.high_m, (self.solids,))

    def occupy(
        self,
        boxes: Sequence[Box],
        zones: Sequence[Box] = (),
        fronts: Sequence[Box] = (),
        targets: Sequence[Target] = (),
    ) -> None:
        """Stand something in the room: its boxes, space that stays free for it, floor before it, spots to be reached.

        In ``zones`` nothing may be, for doors open there; in ``fronts`` nothing may stand.
        """
        self._stand, self._reach = self._after(boxes)
        self.solids.extend(boxes)
        self.zones.extend(zones)
        self.fronts.extend(fronts)
        self._targets += [self._cells_of(t) for t in targets]

    def collides(self, boxes: FloatArray) -> BoolArray:
        """Which candidates meet a solid. boxes: (n, 6); result: (n,)."""
        return self.solids.meets(boxes)

    def blocks_zone(self, boxes: FloatArray) -> BoolArray:
        """Which candidates would stand in a zone or front that must stay free. boxes: (n, 6); result: (n,)."""
        return self.zones.meets(boxes) | self.fronts.meets(boxes)

    def hangs_in_zone(self, boxes: FloatArray) -> BoolArray:
        """Which candidates would hang in a zone that must stay free. boxes: (n, 6); result: (n,)."""
        return self.zones.meets(boxes)

    def surely_barred(self, boxes: FloatArray, *, hung: bool) -> BoolArray:
        """A quick look: candidates that certainly meet a solid or a zone. boxes: (n, 6), all of one height; result: (n,)."""
        return (self._hung_planes if hung else self._planes).meets(boxes)

    def surely_collides(self, boxes: FloatArray) -> BoolArray:
        """A quick look: candidates that certainly meet a solid. boxes: (n, 6), all of one height; result: (n,)."""
        return self._solid_planes.meets(boxes)

    def reachable(self, extra: Sequence[Box] = (), targets: Sequence[Target] = ()) -> bool:
        """True when, with the extra solids in place, doorways, targets and nearly all floor share one stretch of free floor."""
        if not self._joined:
            return False
        stand, reach = self._after(extra)
        if not all(reach[cell] for cell in self._doors):
            return False
        if reach is not self._reach and int(stand.sum()) - int(reach.sum()) > _ISLAND_CELLS:
            return False
        if not all(self._touches(reach, t) for t in targets):
            return False
        lost = self._window_of(extra)
        if lost is None or reach is self._reach:
            return True
        # Cells outside the window change only where an island was cut off, which the count shows.
        i0, i1, j0, j1 = lost
        inside = self._reach[i0:i1, j0:j1].sum() - reach[i0:i1, j0:j1].sum()
        everywhere = int(self._reach.sum()) != int(reach.sum()) + int(inside)
        near = (t for t in self._targets if everywhere or _overlap(t, lost))
        return all(reach[a:b, c:d].any() for a, b, c, d in near)

    def free_cells(self) -> FloatArray:
        """Centres of the cells where the robot's base can stand, connected to the doorways; shape (n, 2)."""
        cells = self._origin + (np.argwhere(self._reach) + 0.5) * CELL_M
        inside = np.all((cells > self.room.low_m) & (cells < self.room.high_m), axis=1)
        return np.asarray(cells[inside])

    def inward(self, opening: Doorway | Window) -> tuple[float, float]:
        """Unit vector from a doorway or window into this room."""
        if opening.along == "x":
            return (0.0, 1.0 if self.room.center_m[1] > opening.center_m[1] else -1.0)
        return (1.0 if self.room.center_m[0] > opening.center_m[0] else -1.0, 0.0)

    # Floor

    def _after(self, extra: Sequence[Box]) -> tuple[BoolArray, BoolArray]:
        """Where the base can stand, and where of that it can get, with the extra boxes in the room."""
        window = self._window_of(extra)
        if window is None:
            return self._stand, self._reach
        i0, i1, j0, j1 = window
        lost = np.zeros((i1 - i0, j1 - j0), dtype=bool)
        for box in extra:
            if _bars(box):
                a, b, c, d = self._touched(box)
                di = _away(np.arange(i0, i1), a, b)
                dj = _away(np.arange(j0, j1), c, d)
                lost |= di[:, None] ** 2 + dj[None, :] ** 2 < _KEEP_CELLS**2
        stand = self._stand.copy()
        stand[i0:i1, j0:j1] &= ~lost
        if not np.any(self._reach[i0:i1, j0:j1] & lost):
            return stand, self._reach
        reach = self._reach.copy()
        reach[i0:i1, j0:j1] &= ~lost
        if not reach[self._doors[0]] or not self._still_joined(reach, window):
            reach = _component(reach, self._doors[:1])
        return stand, reach

    def _still_joined(self, reach: BoolArray, window: _Cells) -> bool:
        """Whether what is left around the window hangs together there: then it does so everywhere."""
        i0, i1, j0, j1 = window
        near = reach[max(0, i0 - _AROUND) : i1 + _AROUND, max(0, j0 - _AROUND) : j1 + _AROUND]
        return bool(ndimage.label(near)[1] == 1)

    def _touches(self, reach: BoolArray, target: Target) -> bool:
        i0, i1, j0, j1 = self._cells_of(target)
        return bool(reach[i0:i1, j0:j1].any())

    def _cells_of(self, target: Target) -> _Cells:
        """Cells whose centres lie in the strip."""
        x0, y0, x1, y1 = target.strip
        return self._cells((x0, x1), (y0, y1))

    def _touched(self, box: Box) -> _Cells:
        """Every cell that the box touches, so that no other grid over the same room finds less floor."""
        return self._cells((box[0] - _HALF, box[3] + _HALF), (box[1] - _HALF, box[4] + _HALF))

    def _cells(self, x: tuple[float, float], y: tuple[float, float]) -> _Cells:
        i0, i1 = (math.ceil((v - self._origin[0]) / CELL_M - 0.5) for v in (x[0] + 1e-9, x[1] - 1e-9))
        j0, j1 = (math.ceil((v - self._origin[1]) / CELL_M - 0.5) for v in (y[0] + 1e-9, y[1] - 1e-9))
        nx, ny = self._shape
        return (min(max(i0, 0), nx), min(max(i1, 0), nx), min(max(j0, 0), ny), min(max(j1, 0), ny))

    def _window_of(self, boxes: Sequence[Box]) -> _Cells | None:
        """Cells that the boxes take from the robot; None when they bar nothing."""
        spans = [self._touched(box) for box in boxes if _bars(box)]
        if not spans:
            return None
        i0, i1 = min(s[0] for s in spans) - _RING, max(s[1] for s in spans) + _RING
        j0, j1 = min(s[2] for s in spans) - _RING, max(s[3] for s in spans) + _RING
        nx, ny = self._shape
        return (max(i0, 0), min(i1, nx), max(j0, 0), min(j1, ny))

    # Zones

    def _door_zone(self, doorway: Doorway) -> Box:
        """Floor that stays free inside the room before a doorway."""
        depth = min(DOOR_CLEAR_M, 0.7 * min(self.room.size_m))
        x0, y0, x1, y1 = self._before(doorway, depth)
        return (x0, y0, 0.0, x1, y1, DOOR_HEIGHT_M)

    def _window_zone(self, window: Window) -> Box:
        """Space that stays free inside the room before a window."""
        x0, y0, x1, y1 = self._before(window, min(WINDOW_CLEAR_M, 0.7 * min(self.room.size_m)))
        return (x0, y0, max(window.sill_m, WINDOW_FROM_M), x1, y1, window.head_m)

    def _before(self, opening: Doorway | Window, depth_m: float) -> tuple[float, float, float, float]:
        """The strip (x0, y0, x1, y1) of this depth before an opening, from the middle of its wall."""
        x, y = opening.center_m
        half, far = opening.width_m / 2, depth_m + WALL_M / 2
        nx, ny = self.inward(opening)
        if opening.along == "x":
            return (x - half, min(y, y + far * ny), x + half, max(y, y + far * ny))
        return (min(x, x + far * nx), y - half, max(x, x + far * nx), y + half)


def _grid_of(room: Room) -> tuple[FloatArray, tuple[int, int]]:
    """Corner of the room's grid and its cells along x and y."""
    origin = np.asarray(room.low_m) - _MARGIN_M
    cells = np.ceil((np.asarray(room.size_m) + 2 * _MARGIN_M) / CELL_M).astype(int)
    return origin, (int(cells[0]), int(cells[1]))


@functools.lru_cache(maxsize=64)
def _bare_floor(room: Room, doorways: tuple[Doorway, ...]) -> tuple[BoolArray, BoolArray, tuple[_Cell, ...]]:
    """Where the base can stand in the empty room, where of that it gets from the doorways, and a cell before each of them.

    A doorway with no floor before it that the base fits on has no cell: then there are no cells at all.
    """
    origin, shape = _grid_of(room)
    x, y = (origin[axis] + (np.arange(shape[axis]) + 0.5) * CELL_M for axis in (0, 1))

    def within(low: tuple[float, float], high: tuple[float, float]) -> BoolArray:
        return np.asarray(((x >= low[0]) & (x < high[0]))[:, None] & ((y >= low[1]) & (y < high[1]))[None, :])

    floor = within(room.low_m, room.high_m)
    for door in doorways:
        if door.rooms[1]:
            (cx, cy), half, deep = door.center_m, door.width_m / 2, _MARGIN_M + 0.2
            a, b = (half, deep) if door.along == "x" else (deep, half)
            floor |= within((cx - a, cy - b), (cx + a, cy + b))
    stand = np.asarray(ndimage.distance_transform_edt(floor) >= _KEEP_CELLS)
    found = [_before_door(stand, origin, room, door) for door in doorways]
    cells = tuple(cell for cell in found if cell is not None) if None not in found else ()
    return stand, _component(stand, cells[:1]), cells


def _before_door(stand: BoolArray, origin: FloatArray, room: Room, door: Doorway) -> _Cell | None:
    """The standable cell nearest to half a metre inside the doorway, no further off than another half."""
    cells = np.argwhere(stand)
    if not len(cells):
        return None
    x, y = door.center_m
    side = 1 if door.along == "x" else 0
    step = 0.5 if room.center_m[side] > door.center_m[side] else -0.5
    spot = np.array([x, y + step] if side else [x + step, y])
    away = np.hypot(*(origin + (cells + 0.5) * CELL_M - spot).T)
    best = int(np.argmin(away))
    return (int(cells[best, 0]), int(cells[best, 1])) if away[best] < 0.5 else None


def _component(free: BoolArray, seeds: Sequence[_Cell]) -> BoolArray:
    """The connected part of the free cells that holds the first seed; empty without one."""
    if not seeds or not free[seeds[0]]:
        return np.zeros_like(free)
    labels: NDArray[np.int32] = ndimage.label(free)[0]
    return np.asarray(labels == labels[seeds[0]])


def _bars(box: Box) -> bool:
    """Whether the robot has to go around the box."""
    return box[2] < ROBOT.height_m and box[5] > LOW_M


def _away(cells: NDArray[np.int64], first: int, end: int) -> NDArray[np.int64]:
    """How many cells each one lies before the first or after the last cell of a span."""
    return np.asarray(np.maximum(np.maximum(first - cells, cells - (end - 1)), 0))


def _overlap(a: _Cells, b: _Cells) -> bool:
    return a[0] < b[1] and b[0] < a[1] and a[2] < b[3] and b[2] < a[3]
