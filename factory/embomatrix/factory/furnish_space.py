"""A room while it is being furnished: solids, keep-out zones and the floor that the robot can still reach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy import ndimage

from embomatrix.factory.floorplan_walls import WALL_M
from embomatrix.skills.limits import ROBOT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from embomatrix.world.scene import Doorway, Room, Window

    FloatArray = NDArray[np.float64]
    BoolArray = NDArray[np.bool_]

CELL_M: Final = 0.05
DOOR_CLEAR_M: Final = 0.8
DOOR_HEIGHT_M: Final = 2.1
WINDOW_CLEAR_M: Final = 0.5
WINDOW_FROM_M: Final = 0.9
"""What is no higher than this may stand before a window, however low its sill: a sofa, a desk, a counter."""
LOW_M: Final = 0.03
"""What is no higher than this is floor to the robot: a rug."""
_TOUCH_M: Final = 1e-4
_MARGIN_M: Final = 0.3
_BASE_CLEAR_M: Final = ROBOT.radius_m + 0.01
_HALF: Final = CELL_M / 2

Box = tuple[float, float, float, float, float, float]
"""(x0, y0, z0, x1, y1, z1) in the world."""


@dataclass(frozen=True, slots=True)
class Target:
    """A strip of floor, (x0, y0, x1, y1), that must hold a spot where the robot can stand."""

    strip: tuple[float, float, float, float]


class RoomSpace:
    """Occupancy of one room. Boxes are axis-aligned: everything on the floor stands at quarter turns."""

    def __init__(self, room: Room, doorways: Sequence[Doorway], windows: Sequence[Window] = ()) -> None:
        self.room = room
        self.doorways = tuple(d for d in doorways if room.name in d.rooms)
        self.solids: list[Box] = []
        self.zones: list[Box] = [
            *(self._door_zone(d) for d in self.doorways),
            *(self._window_zone(w) for w in windows if room.name in w.rooms),
        ]
        self.targets: list[Target] = []
        self._origin = np.asarray(room.low_m) - _MARGIN_M
        cells = np.ceil((np.asarray(room.size_m) + 2 * _MARGIN_M) / CELL_M).astype(int)
        self._x = self._origin[0] + (np.arange(cells[0]) + 0.5) * CELL_M
        self._y = self._origin[1] + (np.arange(cells[1]) + 0.5) * CELL_M
        self._floor = self._empty_floor()

    def collides(self, boxes: FloatArray) -> BoolArray:
        """Which candidates meet a solid. boxes: (n, 6); result: (n,)."""
        return _meet(boxes, self.solids)

    def blocks_zone(self, boxes: FloatArray) -> BoolArray:
        """Which candidates stand in a zone that must stay free. boxes: (n, 6); result: (n,)."""
        return _meet(boxes, self.zones)

    def reachable(self, extra: Sequence[Box] = (), targets: Sequence[Target] = ()) -> bool:
        """True when, with the extra solids in place, all doorways and all targets share one stretch of free floor."""
        labels = self._labels(extra)
        doors = [self._label_at(labels, d) for d in self.doorways]
        if not doors or 0 in doors or len(set(doors)) > 1:
            return False
        main = doors[0]
        return all(self._touches(labels, t, main) for t in (*self.targets, *targets))

    def free_cells(self) -> FloatArray:
        """Centres of the cells where the robot's base can stand, connected to the doorways; shape (n, 2)."""
        labels = self._labels(())
        if not self.doorways:
            return np.empty((0, 2))
        main = self._label_at(labels, self.doorways[0])
        ix, iy = np.nonzero((labels == main) & (main > 0))
        cells = np.stack([self._x[ix], self._y[iy]], axis=1)
        inside = np.all((cells > self.room.low_m) & (cells < self.room.high_m), axis=1)
        return np.asarray(cells[inside])

    def _labels(self, extra: Sequence[Box]) -> NDArray[np.int32]:
        free = self._floor.copy()
        for x0, y0, z0, x1, y1, z1 in (*self.solids, *extra):
            if z0 < ROBOT.height_m and z1 > LOW_M:
                # Every cell that the box touches, so that no other grid over the same room finds less floor.
                free[
                    self._span(self._x, x0 - _HALF, x1 + _HALF), self._span(self._y, y0 - _HALF, y1 + _HALF)
                ] = False
        distance = ndimage.distance_transform_edt(free) * CELL_M
        labels: NDArray[np.int32] = ndimage.label(distance - _HALF >= _BASE_CLEAR_M)[0]
        return labels

    def _touches(self, labels: NDArray[np.int32], target: Target, main: int) -> bool:
        x0, y0, x1, y1 = target.strip
        return bool(np.any(labels[self._span(self._x, x0, x1), self._span(self._y, y0, y1)] == main))

    def _label_at(self, labels: NDArray[np.int32], doorway: Doorway) -> int:
        """The label of the floor half a metre inside the doorway."""
        x, y = doorway.center_m
        nx, ny = self.inward(doorway)
        i = int(np.searchsorted(self._x, x + 0.5 * nx))
        j = int(np.searchsorted(self._y, y + 0.5 * ny))
        return int(labels[min(i, len(self._x) - 1), min(j, len(self._y) - 1)])

    def inward(self, opening: Doorway | Window) -> tuple[float, float]:
        """Unit vector from the opening into this room."""
        if opening.along == "x":
            return (0.0, 1.0 if self.room.center_m[1] > opening.center_m[1] else -1.0)
        return (1.0 if self.room.center_m[0] > opening.center_m[0] else -1.0, 0.0)

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

    def _empty_floor(self) -> BoolArray:
        floor = np.zeros((len(self._x), len(self._y)), dtype=bool)
        (x0, y0), (x1, y1) = self.room.low_m, self.room.high_m
        floor[self._span(self._x, x0, x1), self._span(self._y, y0, y1)] = True
        for door in self.doorways:
            if door.rooms[1]:
                x, y = door.center_m
                half, deep = door.width_m / 2, _MARGIN_M + 0.2
                a, b = (half, deep) if door.along == "x" else (deep, half)
                floor[self._span(self._x, x - a, x + a), self._span(self._y, y - b, y + b)] = True
        return floor

    @staticmethod
    def _span(centers: FloatArray, low: float, high: float) -> slice:
        return slice(int(np.searchsorted(centers, low + 1e-9)), int(np.searchsorted(centers, high - 1e-9)))


def _meet(boxes: FloatArray, others: Sequence[Box]) -> BoolArray:
    if not others or not len(boxes):
        return np.zeros(len(boxes), dtype=bool)
    rest = np.asarray(others)  # (m, 6)
    low, high = boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)
    rest = rest[~np.any((rest[:, 3:] <= low) | (rest[:, :3] >= high), axis=1)]
    meets = np.ones((len(boxes), len(rest)), dtype=bool)
    for axis in range(3):
        meets &= boxes[:, None, axis] < rest[None, :, axis + 3] - _TOUCH_M
        meets &= rest[None, :, axis] < boxes[:, None, axis + 3] - _TOUCH_M
    return np.asarray(meets.any(axis=1))
