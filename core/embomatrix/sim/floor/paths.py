"""Shortest paths over the free cells of a floor."""

import functools
import heapq
import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from embomatrix.sim.caches import RecentCache
from embomatrix.sim.floor.components import Window
from embomatrix.world.geometry import FloatArray

BoolArray = NDArray[np.bool_]

Cell = tuple[int, int]

CROSSING_COST: Final = 100.0
"""Cost of a blocked cell in free cells: driving through an object is as bad as a detour of this many per cell."""
FIELDS_KEPT: Final = 64
"""Distance fields in memory, 0.2 MB each in a flat of 120 m2."""


class Distances:
    """Distances in metres along the free cells of one floor, whose border is blocked."""

    def __init__(self, free: BoolArray, cell_m: float) -> None:
        self._free = free
        self._cell_m = cell_m
        self._fields: RecentCache[Cell, FloatArray] = RecentCache(FIELDS_KEPT)

    def to(self, cell: Cell) -> FloatArray:
        """Metres from every cell to this one, in the floor's shape; infinity for no path."""
        return self._fields.get(cell, lambda: self._find_field(cell))

    def _find_field(self, cell: Cell) -> FloatArray:
        source = cell[0] * self._free.shape[1] + cell[1]
        field = np.asarray(csgraph.dijkstra(self._graph, indices=source), dtype=np.float32)
        return np.asarray(field.reshape(self._free.shape))

    def descent(self, start: Cell, end: Cell) -> list[Cell]:
        """Cells of a shortest path between two connected cells, both included."""
        field = self.to(end)
        cells = [start]
        while cells[-1] != end:
            cells.append(min(self._neighbours(*cells[-1]), key=lambda cell: (float(field[cell]), cell)))
        return cells

    def _neighbours(self, i: int, j: int) -> list[Cell]:
        """Free neighbours of a cell; a diagonal one only if both cells beside it are free."""
        free = self._free
        return [
            (i + di, j + dj)
            for di in (-1, 0, 1)
            for dj in (-1, 0, 1)
            if (di or dj)
            and free[i + di, j + dj]
            and (not (di and dj) or (free[i + di, j] and free[i, j + dj]))
        ]

    @functools.cached_property
    def _graph(self) -> sparse.csr_matrix:
        """Eight-neighbour graph of the free cells. A diagonal exists only if both cells beside it are free."""
        free, (rows, columns) = self._free, self._free.shape
        number = np.arange(rows * columns).reshape(free.shape)
        starts, ends, lengths = [], [], []
        for di, dj in ((1, 0), (0, 1), (1, 1), (1, -1)):
            a = (slice(0, rows - di), slice(max(0, -dj), columns - max(0, dj)))
            b = (slice(di, rows), slice(max(0, dj), columns - max(0, -dj)))
            both = free[a] & free[b]
            if di and dj:
                both &= free[a[0], b[1]] & free[b[0], a[1]]
            starts.append(number[a][both])
            ends.append(number[b][both])
            lengths.append(np.full(int(both.sum()), self._cell_m * math.hypot(di, dj)))
        source, target, weight = (np.concatenate(items) for items in (starts, ends, lengths))
        size = rows * columns
        one_way = sparse.coo_matrix((weight, (source, target)), shape=(size, size))
        return (one_way + one_way.T).tocsr()


def cheapest_path(free: BoolArray, floor: BoolArray, start: Cell, goal: Window) -> list[Cell]:
    """Cells of the path from the start to a free cell in the goal with the fewest blocked cells, in reverse.

    The path stays on ``floor``. Empty for no path.
    """
    cost = np.where(free, 1.0, CROSSING_COST)
    seen = np.full(free.shape, np.inf)
    seen[start] = 0.0
    came: dict[Cell, Cell] = {}
    queue = [(0.0, start)]
    rows, columns = goal
    while queue:
        spent, (i, j) = heapq.heappop(queue)
        if spent > seen[i, j]:
            continue
        if rows.start <= i < rows.stop and columns.start <= j < columns.stop and free[i, j]:
            break
        for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if floor[cell] and spent + cost[cell] < seen[cell]:
                seen[cell] = spent + cost[cell]
                came[cell] = (i, j)
                heapq.heappush(queue, (float(seen[cell]), cell))
    else:
        return []
    way = [(i, j)]
    while way[-1] in came:
        way.append(came[way[-1]])
    return way
