"""Which boxes lie near a place: a hash of square cells in the plane, in plain Python.

A household query meets a dozen boxes. Whole-array comparisons of three hundred cost more than looking at those few.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.world.geometry import Aabb

CELL_M: Final = 0.5
WIDE_CELLS: Final = 64
"""A box over more cells than this is looked at in every query instead: a carpet, or a thing thrown far away."""

Cell = tuple[int, int]


class Neighbourhood:
    """Numbered boxes that can be moved, taken out and asked for by place."""

    def __init__(self) -> None:
        self._boxes: dict[int, Aabb] = {}
        self._cells: dict[Cell, dict[int, None]] = {}
        self._wide: dict[int, None] = {}

    def put(self, number: int, box: Aabb) -> None:
        """Add a box, or move it."""
        before = self._boxes.get(number)
        self._boxes[number] = box
        if before is not None:
            if _span(before) == _span(box):
                return
            self._forget(number, before)
        cells = self._cells_of(_span(box))
        if cells is None:
            self._wide[number] = None
            return
        for cell in cells:
            self._cells.setdefault(cell, {})[number] = None

    def take_out(self, number: int) -> None:
        """Remove a box. One that is not there is left so."""
        before = self._boxes.pop(number, None)
        if before is not None:
            self._forget(number, before)

    def near(self, box: Aabb, reach_m: float = 0.0) -> list[int]:
        """Numbers of the boxes that overlap this one or come as near on every axis as ``reach_m``, in rising order."""
        (low_x, low_y, low_z), (high_x, high_y, high_z) = box.low_m, box.high_m
        low_x, low_y, low_z = low_x - reach_m, low_y - reach_m, low_z - reach_m
        high_x, high_y, high_z = high_x + reach_m, high_y + reach_m, high_z + reach_m
        found = set()
        boxes = self._boxes
        for number in self._candidates(low_x, low_y, high_x, high_y):
            other = boxes[number]
            x, y, z = other.low_m
            if x <= high_x and y <= high_y and z <= high_z:
                x, y, z = other.high_m
                if x >= low_x and y >= low_y and z >= low_z:
                    found.add(number)
        return sorted(found)

    def _candidates(self, low_x: float, low_y: float, high_x: float, high_y: float) -> Iterator[int]:
        cells = self._cells_of(_corners(low_x, low_y, high_x, high_y))
        if cells is None:
            yield from self._boxes
            return
        yield from self._wide
        for cell in cells:
            yield from self._cells.get(cell, ())

    def _forget(self, number: int, box: Aabb) -> None:
        cells = self._cells_of(_span(box))
        if cells is None:
            del self._wide[number]
            return
        for cell in cells:
            del self._cells[cell][number]

    @staticmethod
    def _cells_of(span: tuple[int, int, int, int]) -> list[Cell] | None:
        """Cells of a span, None when they are too many."""
        first_i, first_j, last_i, last_j = span
        if (last_i - first_i + 1) * (last_j - first_j + 1) > WIDE_CELLS:
            return None
        return [(i, j) for i in range(first_i, last_i + 1) for j in range(first_j, last_j + 1)]


def _span(box: Aabb) -> tuple[int, int, int, int]:
    return _corners(box.low_m[0], box.low_m[1], box.high_m[0], box.high_m[1])


def _corners(low_x: float, low_y: float, high_x: float, high_y: float) -> tuple[int, int, int, int]:
    """First and last cell along x and y: i first, j first, i last, j last."""
    floor = math.floor
    return floor(low_x / CELL_M), floor(low_y / CELL_M), floor(high_x / CELL_M), floor(high_y / CELL_M)
