"""Axis-aligned boxes in bulk: a growing stack of them, and tables that rule most candidates out at a glance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from embomatrix.world.geometry import Vec2

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

Box = tuple[float, float, float, float, float, float]
"""(x0, y0, z0, x1, y1, z1) in the world."""

TOUCH_M: Final = 1e-4
"""Boxes that overlap by less than this along an axis only touch."""
_HEIGHTS_M: Final = (0.1, 0.7, 1.5, 2.1)
_MOST_CELLS: Final = 40_000


class BoxStack:
    """Boxes in an array that grows: (n, 6), in the order in which they came."""

    def __init__(self, boxes: Iterable[Box] = ()) -> None:
        self._rows = np.empty((64, 6))
        self._count = 0
        self.extend(boxes)

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> FloatArray:
        """All boxes, shape (n, 6); a view that the next `extend` may leave behind."""
        return self._rows[: self._count]

    def extend(self, boxes: Iterable[Box]) -> None:
        """Add boxes at the end."""
        for box in boxes:
            if self._count == len(self._rows):
                self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
            self._rows[self._count] = box
            self._count += 1

    def meets(self, boxes: FloatArray) -> BoolArray:
        """Which candidates overlap any of the stack. boxes: (n, 6); result: (n,)."""
        if not self._count or not len(boxes):
            return np.zeros(len(boxes), dtype=bool)
        rest = self.rows
        low, high = boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)
        rest = rest[~np.any((rest[:, 3:] <= low) | (rest[:, :3] >= high), axis=1)]
        meets = np.ones((len(boxes), len(rest)), dtype=bool)
        for axis in range(3):
            meets &= boxes[:, None, axis] < rest[None, :, axis + 3] - TOUCH_M
            meets &= rest[None, :, axis] < boxes[:, None, axis + 3] - TOUCH_M
        return np.asarray(meets.any(axis=1))


class Planes:
    """Summed-area tables of what stacks hold at a few heights: a candidate over a taken point certainly meets it.

    A table counts the grid points that lie in a box which spans its height (Crow, "Summed-area tables", 1984); four look-ups
    then tell whether a rectangle holds any. Tables are made again when a stack has grown.
    """

    def __init__(self, low_m: Vec2, high_m: Vec2, stacks: Sequence[BoxStack]) -> None:
        size = np.asarray(high_m) - np.asarray(low_m)
        self._step = max(0.05, math.sqrt(float(np.prod(size)) / _MOST_CELLS))
        self._low = np.asarray(low_m)
        self._shape = np.ceil(size / self._step).astype(int) + 1
        self._stacks = tuple(stacks)
        self._tables: dict[float, tuple[int, NDArray[np.int64]]] = {}

    def meets(self, boxes: FloatArray) -> BoolArray:
        """Candidates that hold a taken point. boxes: (n, 6), all from the same underside to the same top; result: (n,)."""
        if not len(boxes):
            return np.zeros(0, dtype=bool)
        height = next(
            (z for z in _HEIGHTS_M if boxes[0, 2] < z - TOUCH_M and boxes[0, 5] > z + TOUCH_M), None
        )
        if height is None:
            return np.zeros(len(boxes), dtype=bool)
        table = self._table(height)
        first = self._index(boxes[:, :2] + TOUCH_M)  # (n, 2)
        end = np.maximum(first, self._index(boxes[:, 3:5] - TOUCH_M))
        taken = (
            table[end[:, 0], end[:, 1]]
            - table[first[:, 0], end[:, 1]]
            - table[end[:, 0], first[:, 1]]
            + table[first[:, 0], first[:, 1]]
        )
        return np.asarray(taken > 0)

    def _table(self, height: float) -> NDArray[np.int64]:
        count = sum(len(s) for s in self._stacks)
        made = self._tables.get(height)
        if made is not None and made[0] == count:
            return made[1]
        points = np.zeros(self._shape, dtype=np.int64)
        for stack in self._stacks:
            rows = stack.rows
            rows = rows[(rows[:, 2] < height - TOUCH_M) & (rows[:, 5] > height + TOUCH_M)]
            first, end = self._index(rows[:, :2] + TOUCH_M), self._index(rows[:, 3:5] - TOUCH_M)
            for (i0, j0), (i1, j1) in zip(first, end, strict=True):
                points[i0:i1, j0:j1] = 1
        table = np.zeros(self._shape + 1, dtype=np.int64)
        table[1:, 1:] = points.cumsum(axis=0).cumsum(axis=1)
        self._tables[height] = (count, table)
        return table

    def _index(self, spots: FloatArray) -> NDArray[np.int64]:
        """Number of the first grid point at or after each spot, along x and y. spots: (n, 2)."""
        found = np.ceil((spots - self._low) / self._step - 0.5).astype(np.int64)
        return np.asarray(np.clip(found, 0, self._shape))
