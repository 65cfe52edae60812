"""Occupancy grid of the floor for the centre of a round robot, with components and distances."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.caches import RecentCache
from embomatrix.sim.floor.components import FloorParts, Window, overlap
from embomatrix.sim.floor.paths import Cell, Distances, cheapest_path
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import FloatArray, Vec2
from embomatrix.world.scene import Scene

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int16]
Changes = tuple[tuple[FloatArray, int], ...]
Blocked = tuple[Window, BoolArray]
"""Window, and its cells in which the robot would touch an obstacle."""

CELL_M: Final = 0.05
SNAP_CELLS: Final = 6
"""A robot within 30 cm of a free cell counts as standing on it."""
FLOORS_KEPT: Final = 3
"""Most recently used floors with distances in memory: those of a house with a garden take 20 MB."""
DOORWAY_DEPTH_M: Final = 0.4
"""Depth of a doorway's floor, centred on the wall: more than any wall's thickness."""


class FloorGrid:
    """Cells of 5 cm over the bounding rectangle of the rooms. Only rooms and doorways are floor.

    A scene's grid is built once; ``changed`` derives the next grid at the cost of the changed region.
    """

    def __init__(
        self, scene: Scene, boxes: FloatArray, stored: tuple[NDArray[np.int16], BoolArray] | None = None
    ) -> None:
        """Rasterise obstacles, shape (n, 6), and inflate them by the robot's radius.

        ``stored`` are ``covered`` and ``free`` of an earlier grid of these boxes, of shape ``grid_shape``.
        """
        self._origin = _origin_of(scene)
        self._origin_m = (float(self._origin[0]), float(self._origin[1]))
        self._shape = grid_shape(scene)
        self._changes: Changes = ()
        self._recent: RecentCache[object, Distances] = RecentCache(FLOORS_KEPT)
        self._own = object()
        covered, free = stored or (self._rasterised(scene, boxes), None)
        self._covered = covered
        self._free: BoolArray | None = clear_floor(covered) if free is None else free

    def _rasterised(self, scene: Scene, boxes: FloatArray) -> NDArray[np.int16]:
        covered = (~_floor_of(scene, self._shape, self._window)).astype(np.int16)
        for box in boxes.tolist():
            covered[self._window(box[:2], box[2:4])] += 1
        for edge in (np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1]):
            covered[edge] += 1
        return covered

    @property
    def covered(self) -> NDArray[np.int16]:
        """Number of obstacles over each cell, plus one outside the floor."""
        return self._covered_in((slice(0, self._shape[0]), slice(0, self._shape[1])), self._changes)

    def _covered_in(self, window: Window, changes: Changes) -> NDArray[np.int16]:
        """Number of obstacles over a window's cells, after changes to the first grid."""
        covered = self._covered[window].copy()
        for boxes, step in changes:
            for box in boxes.tolist():
                here, _ = overlap(window, self._window(box[:2], box[2:4]))
                covered[here] += step
        return covered

    def changed(self, gone: FloatArray, come: FloatArray) -> FloorGrid:
        """Grid without some obstacles and with others, each of shape (n, 6)."""
        boxes = np.concatenate([gone, come])  # (n, 6)
        if not len(boxes):
            return self
        reach = ROBOT.radius_m + CELL_M
        edge = reach + CELL_M
        low, high = boxes[:, :2].min(axis=0) - edge, boxes[:, 2:4].max(axis=0) + edge
        window = self._window(low.tolist(), high.tolist())
        free = self.parts.within(window) > 0
        changes = (*self._changes, (gone, -1), (come, 1))
        for a, b, c, d in _clusters(boxes, reach):
            here = self._window((a - reach, b - reach), (c + reach, d + reach))
            around = self._window((a - 2 * reach, b - 2 * reach), (c + 2 * reach, d + 2 * reach))
            _, inner = overlap(here, around)
            free[overlap(window, here)[0]] = clear_floor(self._covered_in(around, changes))[inner]
        grid = self._with_parts(self.parts.changed(free, window))
        grid._changes = changes
        return grid

    def narrowed(self, boxes: FloatArray) -> FloorGrid:
        """Grid with temporary obstacles, shape (n, 6), which a later ``changed`` forgets.

        Returns the same grid if the free floor is the same. Costs less than ``changed``, which measures distances anew.
        """
        return self.narrowed_by(self.blocked_by(boxes))

    def narrowed_by(self, blocks: Sequence[Blocked]) -> FloorGrid:
        """Evaluate ``narrowed`` for obstacles by their ``blocked_by``."""
        taken: list[Blocked] = []
        for around, blocked in blocks:
            if (self.parts.within(around)[blocked] > 0).any():
                taken.append((around, blocked))
        if not taken:
            return self
        low = [max(0, min(around[axis].start for around, _ in taken) - 1) for axis in (0, 1)]
        high = [max(around[axis].stop for around, _ in taken) + 1 for axis in (0, 1)]
        window = slice(low[0], min(high[0], self._shape[0])), slice(low[1], min(high[1], self._shape[1]))
        free = self.parts.within(window) > 0
        for around, blocked in taken:
            free[overlap(window, around)[0]] &= ~blocked
        return self._with_parts(self.parts.changed(free, window))

    def blocked_by(self, boxes: FloatArray) -> list[Blocked]:
        """Window and blocked cells around each distinct cell rectangle under the boxes; equal for all grids of a scene."""
        windows = (self._window(box[:2], box[2:4]) for box in boxes.tolist())
        clusters = sorted({(rows.start, rows.stop, cols.start, cols.stop) for rows, cols in windows})
        return [_blocked(slice(*cluster[:2]), slice(*cluster[2:]), self._shape) for cluster in clusters]

    def _with_parts(self, parts: FloorParts) -> FloorGrid:
        """Grid with other free cells that shares the rest: dozens of such grids are in memory."""
        grid = copy.copy(self)
        vars(grid)["parts"] = parts
        grid._free, grid._own = None, object()
        return grid

    @functools.cached_property
    def parts(self) -> FloorParts:
        """Components of the free cells; a changed grid knows nothing else of them."""
        return FloorParts.of(self.free)

    @property
    def free(self) -> BoolArray:
        """Free cells, shape (rows, columns). Read-only."""
        return self._free if self._free is not None else self.parts.numbers > 0

    @property
    def labels(self) -> IntArray:
        """Component number of each free cell, 0 for the others. Read-only."""
        return self.parts.numbers

    def cell(self, x_m: float, y_m: float) -> Cell | None:
        """Free cell at a point, or the nearest one within 30 cm; None for none."""
        if not (math.isfinite(x_m) and math.isfinite(y_m)):
            return None
        i, j = self._cell_at(x_m, y_m)
        if not (0 <= i < self._shape[0] and 0 <= j < self._shape[1]):
            return None
        if self.label((i, j)):
            return (i, j)
        first_i, first_j = max(0, i - SNAP_CELLS), max(0, j - SNAP_CELLS)
        around = slice(first_i, i + SNAP_CELLS + 1), slice(first_j, j + SNAP_CELLS + 1)
        near = np.argwhere(self.parts.within(around) > 0)
        if not len(near):
            return None
        away = (near[:, 0] + first_i - i) ** 2 + (near[:, 1] + first_j - j) ** 2  # (n,) in cells
        best = int(np.argmin(away))
        if away[best] > SNAP_CELLS**2:
            return None
        return (int(near[best, 0]) + first_i, int(near[best, 1]) + first_j)

    def center(self, cell: Cell) -> Vec2:
        """World coordinates of a cell's middle."""
        return (
            self._origin_m[0] + (cell[0] + 0.5) * CELL_M,
            self._origin_m[1] + (cell[1] + 0.5) * CELL_M,
        )

    def is_free(self, x_m: float, y_m: float) -> bool:
        """Return True if the robot fits at a point."""
        return self.label_at(x_m, y_m) > 0

    def label(self, cell: Cell) -> int:
        """Component number of a cell; 0 for a blocked one."""
        return self.parts.at(cell)

    def label_at(self, x_m: float, y_m: float) -> int:
        """Component number at a point; 0 if the robot does not fit."""
        i, j = self._cell_at(x_m, y_m)
        return self.parts.at((i, j)) if 0 <= i < self._shape[0] and 0 <= j < self._shape[1] else 0

    def may_differ_at(self, wider: FloorGrid, x_m: float, y_m: float) -> bool:
        """Return True if a point may be blocked or cut off here but not on the wider grid."""
        if self is wider:
            return False
        renumbered = self.parts.whole is not wider.parts.whole
        label = self.label_at(x_m, y_m)
        return renumbered or not label or label != wider.label_at(x_m, y_m)

    def is_like(self, other: FloorGrid, low_m: Vec2, high_m: Vec2) -> bool:
        """Return True if this grid and its origin have the same components, with the same numbers, in a rectangle."""
        here, _ = overlap(self._window(low_m, high_m), self.parts.window)
        untouched = any(side.start == side.stop for side in here)
        return self.parts.whole is other.parts.whole and other.parts.inner is None and untouched

    def main_part_of(self, wider: FloorGrid, x_m: float, y_m: float) -> int:
        """Largest component of this grid within the component of a point on the wider grid."""
        cell = wider.cell(x_m, y_m)
        return self.parts.largest_in(wider.parts, wider.label(cell)) if cell is not None else 0

    def free_centers(self, low_m: Vec2, high_m: Vec2, label: int | None = None) -> FloatArray:
        """World coordinates of the component's cells in a rectangle, or of all free ones without a label; shape (n, 2)."""
        window = self._window(low_m, high_m)
        numbers = self.parts.within(window)
        chosen = numbers > 0 if label is None else (numbers == label) & (label > 0)
        corner = np.array([window[0].start, window[1].start])
        return np.asarray(self._origin + (np.argwhere(chosen) + corner + 0.5) * CELL_M, dtype=np.float64)

    def distance(self, start: Cell, end: Cell) -> float | None:
        """Length in metres of the shortest path over free cells; None for no path."""
        if not self.label(start) or self.label(start) != self.label(end):
            return None
        return float(self._distances.to(end)[start])

    def path(self, start: Cell, end: Cell) -> tuple[Vec2, ...] | None:
        """Corners of a short path over free cells in the world, both ends included; None for no path.

        Steepest descent of the distance to the end, without the corners that a straight drive can cut.
        """
        if self.distance(start, end) is None:
            return None
        cells = self._distances.descent(start, end)
        corners = [self.center(cells[0])]
        for number in range(2, len(cells)):
            if not self.drives_straight(corners[-1], self.center(cells[number])):
                corners.append(self.center(cells[number - 1]))
        return (*corners, self.center(cells[-1]))

    def crossing(self, start: Cell, low_m: Vec2, high_m: Vec2, floor: BoolArray) -> FloatArray:
        """Blocked cells on the path from a cell into a rectangle that crosses the fewest of them, shape (n, 2).

        The path stays on ``floor``, which has the grid's shape. Empty for no path.
        """
        free, goal = self.free, self._window(low_m, high_m)
        way = cheapest_path(free, floor, start, goal)
        return np.array([self.center(cell) for cell in way if not free[cell]]).reshape(-1, 2)

    def drives_straight(self, start: Vec2, end: Vec2) -> bool:
        """Return True if the robot fits everywhere on the line between two points."""
        count = max(1, math.ceil(math.dist(start, end) / (CELL_M / 2)))
        shares = np.linspace(0.0, 1.0, count + 1)[:, None]
        points = np.asarray(start) + shares * (np.asarray(end) - np.asarray(start))  # (n, 2)
        cells = np.floor((points - self._origin) / CELL_M).astype(int)
        low, high = cells.min(axis=0), cells.max(axis=0)
        if (low < 0).any() or (high >= self._shape).any():
            return False
        passed = self.parts.within(
            (slice(int(low[0]), int(high[0]) + 1), slice(int(low[1]), int(high[1]) + 1))
        )
        return bool((passed[cells[:, 0] - low[0], cells[:, 1] - low[1]] > 0).all())

    @property
    def _distances(self) -> Distances:
        return self._recent.get(self._own, lambda: Distances(self.free, CELL_M))

    def _cell_at(self, x_m: float, y_m: float) -> Cell:
        low_x, low_y = self._origin_m
        return math.floor((x_m - low_x) / CELL_M), math.floor((y_m - low_y) / CELL_M)

    def _window(self, low: Sequence[float], high: Sequence[float]) -> Window:
        """Cells that a rectangle touches with more than its edge."""
        rows, columns = (
            slice(*_cells_between(*ends)) for ends in zip(low, high, self._origin_m, self._shape, strict=True)
        )
        return rows, columns


def _floor_of(
    scene: Scene, shape: tuple[int, int], window: Callable[[Sequence[float], Sequence[float]], Window]
) -> BoolArray:
    """Cells of rooms and inner doorways; ``window`` maps a rectangle to cells."""
    floor = np.zeros(shape, dtype=np.bool_)
    for room in scene.rooms:
        floor[window(room.low_m, room.high_m)] = True
    for doorway in scene.doorways:
        half = np.array([doorway.width_m, DOORWAY_DEPTH_M]) / 2
        if doorway.along == "y":
            half = half[::-1]
        if all(doorway.rooms):
            floor[window((doorway.center_m - half).tolist(), (doorway.center_m + half).tolist())] = True
    return floor


def _clusters(boxes: FloatArray, apart_m: float) -> list[list[float]]:
    """Rectangles around all boxes, shape (n, 6); nearby boxes, such as the parts of one object, share one."""
    clusters: list[list[float]] = []
    for a, b, c, d in boxes[:, :4].tolist():
        for cluster in clusters:
            e, f, g, h = cluster
            if a <= g + apart_m and e <= c + apart_m and b <= h + apart_m and f <= d + apart_m:
                cluster[:] = min(a, e), min(b, f), max(c, g), max(d, h)
                break
        else:
            clusters.append([a, b, c, d])
    return clusters


def _cells_between(low_m: float, high_m: float, origin_m: float, count: int) -> tuple[int, int]:
    """Range of cells that an interval touches along one axis. Plain Python: arrays of two are slow."""
    first = min(max(math.floor((low_m - origin_m) / CELL_M + 1e-9), 0), count)
    last = min(max(math.ceil((high_m - origin_m) / CELL_M - 1e-9), first), count)
    return first, last


def clear_floor(covered: NDArray[np.int16]) -> BoolArray:
    """Cells at least a robot's radius from every covered one, in the same shape.

    Spreads covered cells over a disc, row by row: a distance transform takes twenty times as long.
    """
    spread = covered != 0  # covered, then widened to both sides, a cell at a time
    near = spread.copy()
    width = 0
    for rows, columns in _disc_rows():
        for _ in range(columns - width):
            wider = spread.copy()
            wider[:, 1:] |= spread[:, :-1]
            wider[:, :-1] |= spread[:, 1:]
            spread = wider
        width = columns
        near[rows:] |= spread[: -rows or None]
        near[: -rows or None] |= spread[rows:]
    return np.asarray(~near)


@functools.cache
def _disc_rows() -> tuple[tuple[int, int], ...]:
    """Rows from the centre and reach in columns of the cells nearer than the robot's radius, the narrowest first."""
    reach = ROBOT.radius_m / CELL_M
    rows = range(math.ceil(reach))
    columns = (math.ceil(math.sqrt(reach**2 - row**2)) - 1 for row in rows)
    return tuple(sorted(zip(rows, columns, strict=True), key=lambda pair: pair[1]))


def _blocked(rows: slice, columns: slice, shape: tuple[int, int]) -> Blocked:
    """Window around a rectangle of cells in which the robot may touch it, and the blocked cells in it."""
    reach = math.ceil(ROBOT.radius_m / CELL_M)
    around_i = slice(max(0, rows.start - reach), min(shape[0], rows.stop + reach))
    around_j = slice(max(0, columns.start - reach), min(shape[1], columns.stop + reach))
    i, j = np.arange(around_i.start, around_i.stop), np.arange(around_j.start, around_j.stop)
    off_i = np.maximum(np.maximum(rows.start - i, i - rows.stop + 1), 0)
    off_j = np.maximum(np.maximum(columns.start - j, j - columns.stop + 1), 0)
    blocked = off_i[:, None] ** 2 + off_j[None] ** 2 < (ROBOT.radius_m / CELL_M) ** 2
    return (around_i, around_j), np.asarray(blocked)


def grid_shape(scene: Scene) -> tuple[int, int]:
    """Number of cells along x and y: the bounding rectangle of the rooms plus two on each side."""
    highs = np.array([room.high_m for room in scene.rooms])
    span = highs.max(axis=0) + 2 * CELL_M - _origin_of(scene)
    return math.ceil(span[0] / CELL_M), math.ceil(span[1] / CELL_M)


def _origin_of(scene: Scene) -> FloatArray:
    """Lower corner of the first cell, shape (2,)."""
    return np.asarray(np.array([room.low_m for room in scene.rooms]).min(axis=0) - 2 * CELL_M)
