"""Occupancy of a room while it is furnished: solids, zones that stay free, and the floor that the robot can reach."""

import functools
import math
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from embomatrix.factory.floorplan.walls import WALL_M
from embomatrix.skills.limits import ROBOT
from embomatrix.world.scene import Doorway, Room, Window

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Box = tuple[float, float, float, float, float, float]
"""(x0, y0, z0, x1, y1, z1) in the world frame, in metres."""
Rect4 = tuple[float, float, float, float]
"""(x0, y0, x1, y1) in metres."""

CELL_M: Final = 0.05
DOOR_CLEAR_M: Final = 0.8
DOOR_HEIGHT_M: Final = 2.1
WINDOW_CLEAR_M: Final = 0.5
WINDOW_FROM_M: Final = 0.9
"""Lower furniture may stand before a window, however low its sill: a sofa, a desk, a counter."""
LOW_M: Final = 0.03
"""The robot drives over objects up to this height: rugs."""
TOUCH_M: Final = 1e-4
"""Boxes that overlap by less than this along an axis only touch."""
_MARGIN_M: Final = 0.3
_BASE_CLEAR_M: Final = ROBOT.radius_m + 0.01
_HALF: Final = CELL_M / 2
_KEEP_CELLS: Final = (_BASE_CLEAR_M + _HALF) / CELL_M
"""The centre of the base keeps this many cells away from each occupied cell."""
_RING: Final = math.ceil(_KEEP_CELLS)
_AROUND: Final = 2
_ISLAND_CELLS: Final = round(0.5 / CELL_M**2)
"""Unreachable floor that is tolerated: 0.5 m²."""

_Cell = tuple[int, int]
_Cells = tuple[int, int, int, int]
"""(i0, i1, j0, j1): a rectangle of cells."""


class BoxStack:
    """Growing list of axis-aligned boxes. ``rows`` has shape (n, 6), in the order in which boxes were added."""

    def __init__(self, boxes: Iterable[Box] = ()) -> None:
        self.rows: FloatArray = np.array([*boxes], dtype=np.float64).reshape(-1, 6)

    def extend(self, boxes: Iterable[Box]) -> None:
        self.rows = np.concatenate([self.rows, np.array([*boxes], dtype=np.float64).reshape(-1, 6)])

    def meets(self, boxes: FloatArray) -> BoolArray:
        """Mark the candidates that overlap a box of the stack. boxes: (n, 6); result: (n,)."""
        if not len(self.rows) or not len(boxes):
            return np.zeros(len(boxes), dtype=bool)
        low, high = boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)
        rest = self.rows[~np.any((self.rows[:, 3:] <= low) | (self.rows[:, :3] >= high), axis=1)]
        meets = np.ones((len(boxes), len(rest)), dtype=bool)
        for axis in range(3):
            meets &= boxes[:, None, axis] < rest[None, :, axis + 3] - TOUCH_M
            meets &= rest[None, :, axis] < boxes[:, None, axis + 3] - TOUCH_M
        return np.asarray(meets.any(axis=1))


class RoomSpace:
    """Occupancy of one room by axis-aligned boxes: furniture on the floor stands at quarter turns.

    The reachable floor is updated box by box: a new box changes only the cells around it.
    """

    def __init__(self, room: Room, doorways: Sequence[Doorway], windows: Sequence[Window] = ()) -> None:
        self.room = room
        self.doorways = tuple(d for d in doorways if room.name in d.rooms)
        self.windows = tuple(w for w in windows if room.name in w.rooms)
        self.solids = BoxStack()
        self.zones = BoxStack(
            [*(self._door_zone(d) for d in self.doorways), *(self._window_zone(w) for w in self.windows)]
        )
        self.fronts = BoxStack()
        self._origin, self._shape = _grid_of(room)
        self._targets: list[_Cells] = []
        stand, reach, self._doors = _bare_floor(room, self.doorways)
        self._stand, self._reach = stand.copy(), reach.copy()
        self._joined = bool(self._doors) and all(reach[cell] for cell in self._doors)

    def occupy(
        self,
        boxes: Sequence[Box],
        zones: Sequence[Box] = (),
        fronts: Sequence[Box] = (),
        targets: Sequence[Rect4] = (),
    ) -> None:
        """Add furniture: its boxes, the space it needs free, and the floor from which the robot uses it.

        Nothing may be in ``zones``, where doors swing. Nothing may stand in ``fronts``. Each target, a strip of floor, keeps
        a reachable cell.
        """
        self._stand, self._reach = self._after(boxes)
        self.solids.extend(boxes)
        self.zones.extend(zones)
        self.fronts.extend(fronts)
        self._targets += [self._cells_of(t) for t in targets]

    def blocks_zone(self, boxes: FloatArray) -> BoolArray:
        """Mark the candidates that would stand in a zone or front that must stay free. boxes: (n, 6); result: (n,)."""
        return self.zones.meets(boxes) | self.fronts.meets(boxes)

    def reachable(self, extra: Sequence[Box] = (), targets: Sequence[Rect4] = ()) -> bool:
        """True if doorways, targets and nearly all floor stay connected with the extra solids in place."""
        if not self._joined:
            return False
        stand, reach = self._after(extra)
        if not all(reach[cell] for cell in self._doors):
            return False
        if reach is not self._reach and int(stand.sum()) - int(reach.sum()) > _ISLAND_CELLS:
            return False
        if not all(reach[a:b, c:d].any() for a, b, c, d in map(self._cells_of, targets)):
            return False
        lost = self._window_of(extra)
        if lost is None or reach is self._reach:
            return True
        # Cells outside the window change only if an island was cut off, which the count shows.
        i0, i1, j0, j1 = lost
        inside = self._reach[i0:i1, j0:j1].sum() - reach[i0:i1, j0:j1].sum()
        everywhere = int(self._reach.sum()) != int(reach.sum()) + int(inside)
        near = (t for t in self._targets if everywhere or _overlap(t, lost))
        return all(reach[a:b, c:d].any() for a, b, c, d in near)

    def free_cells(self) -> FloatArray:
        """Return the centres of the cells of this room that the robot's base can reach from a doorway, shape (n, 2)."""
        cells = self._origin + (np.argwhere(self._reach) + 0.5) * CELL_M
        inside = np.all((cells > self.room.low_m) & (cells < self.room.high_m), axis=1)
        return np.asarray(cells[inside])

    def inward(self, opening: Doorway | Window) -> tuple[float, float]:
        """Return the unit vector from a doorway or window into this room."""
        if opening.along == "x":
            return (0.0, 1.0 if self.room.center_m[1] > opening.center_m[1] else -1.0)
        return (1.0 if self.room.center_m[0] > opening.center_m[0] else -1.0, 0.0)

    # Floor

    def _after(self, extra: Sequence[Box]) -> tuple[BoolArray, BoolArray]:
        """Return the cells where the base can stand, and those it can reach, with the extra boxes in the room."""
        window = self._window_of(extra)
        if window is None:
            return self._stand, self._reach
        i0, i1, j0, j1 = window
        lost = np.zeros((i1 - i0, j1 - j0), dtype=bool)
        for box in extra:
            if _blocks_robot(box):
                a, b, c, d = self._touched(box)
                di = _cells_outside(np.arange(i0, i1), a, b)
                dj = _cells_outside(np.arange(j0, j1), c, d)
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
        """True if the cells around the window are connected: then the whole floor still is."""
        i0, i1, j0, j1 = window
        near = reach[max(0, i0 - _AROUND) : i1 + _AROUND, max(0, j0 - _AROUND) : j1 + _AROUND]
        return bool(ndimage.label(near)[1] == 1)

    def _cells_of(self, strip: Rect4) -> _Cells:
        """Return the cells with their centres in the strip."""
        x0, y0, x1, y1 = strip
        return self._cells((x0, x1), (y0, y1))

    def _touched(self, box: Box) -> _Cells:
        """Return every cell that the box touches, so that no other grid over this room has less floor."""
        return self._cells((box[0] - _HALF, box[3] + _HALF), (box[1] - _HALF, box[4] + _HALF))

    def _cells(self, x: tuple[float, float], y: tuple[float, float]) -> _Cells:
        i0, i1 = (math.ceil((v - self._origin[0]) / CELL_M - 0.5) for v in (x[0] + 1e-9, x[1] - 1e-9))
        j0, j1 = (math.ceil((v - self._origin[1]) / CELL_M - 0.5) for v in (y[0] + 1e-9, y[1] - 1e-9))
        nx, ny = self._shape
        return (min(max(i0, 0), nx), min(max(i1, 0), nx), min(max(j0, 0), ny), min(max(j1, 0), ny))

    def _window_of(self, boxes: Sequence[Box]) -> _Cells | None:
        """Return the cells that the boxes can take from the robot; None if no box blocks it."""
        spans = [self._touched(box) for box in boxes if _blocks_robot(box)]
        if not spans:
            return None
        i0, i1 = min(s[0] for s in spans) - _RING, max(s[1] for s in spans) + _RING
        j0, j1 = min(s[2] for s in spans) - _RING, max(s[3] for s in spans) + _RING
        nx, ny = self._shape
        return (max(i0, 0), min(i1, nx), max(j0, 0), min(j1, ny))

    # Zones

    def _door_zone(self, doorway: Doorway) -> Box:
        x0, y0, x1, y1 = self._before(doorway, DOOR_CLEAR_M)
        return (x0, y0, 0.0, x1, y1, DOOR_HEIGHT_M)

    def _window_zone(self, window: Window) -> Box:
        x0, y0, x1, y1 = self._before(window, WINDOW_CLEAR_M)
        return (x0, y0, max(window.sill_m, WINDOW_FROM_M), x1, y1, window.head_m)

    def _before(self, opening: Doorway | Window, clear_m: float) -> Rect4:
        """Return the strip (x0, y0, x1, y1) that stays free before an opening, from the middle of its wall."""
        x, y = opening.center_m
        half, far = opening.width_m / 2, min(clear_m, 0.7 * min(self.room.size_m)) + WALL_M / 2
        nx, ny = self.inward(opening)
        if opening.along == "x":
            return (x - half, min(y, y + far * ny), x + half, max(y, y + far * ny))
        return (min(x, x + far * nx), y - half, max(x, x + far * nx), y + half)


def _grid_of(room: Room) -> tuple[FloatArray, tuple[int, int]]:
    """Return the corner of the room's grid and its number of cells along x and y."""
    origin = np.asarray(room.low_m) - _MARGIN_M
    cells = np.ceil((np.asarray(room.size_m) + 2 * _MARGIN_M) / CELL_M).astype(int)
    return origin, (int(cells[0]), int(cells[1]))


@functools.lru_cache(maxsize=64)
def _bare_floor(room: Room, doorways: tuple[Doorway, ...]) -> tuple[BoolArray, BoolArray, tuple[_Cell, ...]]:
    """Return the cells of the empty room where the base can stand, those it can reach, and a cell before each doorway.

    The tuple of cells is empty if the base fits nowhere before one of the doorways.
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
    """Return the free cell nearest to a point 0.5 m inside the doorway, None if it is 0.5 m or more away."""
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
    """Return the connected part of the free cells that holds the first seed; empty without a seed."""
    if not seeds or not free[seeds[0]]:
        return np.zeros_like(free)
    labels: NDArray[np.int32] = ndimage.label(free)[0]
    return np.asarray(labels == labels[seeds[0]])


def _blocks_robot(box: Box) -> bool:
    return box[2] < ROBOT.height_m and box[5] > LOW_M


def _cells_outside(cells: NDArray[np.int64], first: int, end: int) -> NDArray[np.int64]:
    """Return the distance of each cell to the span from ``first`` to ``end`` (exclusive), in cells; 0 inside."""
    return np.asarray(np.maximum(np.maximum(first - cells, cells - (end - 1)), 0))


def _overlap(a: _Cells, b: _Cells) -> bool:
    return a[0] < b[1] and b[0] < a[1] and a[2] < b[3] and b[2] < a[3]
