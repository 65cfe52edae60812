"""Spatial hash of boxes over square cells of the plane, in plain Python.

A query in a household meets a dozen boxes. Checking them costs less than whole-array comparisons of three hundred.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from embomatrix.sim.caches import BoundedCache

if TYPE_CHECKING:
    from embomatrix.world.geometry import Aabb

CELL_M: Final = 1.0
WIDE_CELLS: Final = 32
"""Boxes over more cells, such as a carpet, are checked in every query instead."""
SPANS_KEPT: Final = 1024

Cell = tuple[int, int]
Span = tuple[int, int, int, int]
"""First and last cell along x and y: i first, j first, i last, j last."""
Extent = tuple[float, float, float, float, float, float]


class SpatialHash:
    """Numbered boxes that can be moved, removed and queried by place."""

    def __init__(self) -> None:
        self._cells: dict[Cell, dict[int, Extent]] = {}
        """Boxes over each cell; wide ones are kept separately."""
        self._wide: dict[int, Extent] = {}
        self._seen = BoundedCache(SPANS_KEPT, self._find_places)
        """Buckets by queried span, valid until a new cell appears."""
        self._homes: dict[int, list[dict[int, Extent]]] = {}
        self._spans: dict[int, Span] = {}

    def put(self, number: int, box: Aabb) -> None:
        """Add a box, or move it."""
        extent = (*box.low_m, *box.high_m)
        floor = math.floor
        span = (
            floor(extent[0] / CELL_M),
            floor(extent[1] / CELL_M),
            floor(extent[3] / CELL_M),
            floor(extent[4] / CELL_M),
        )
        if self._spans.get(number) != span:
            self.take_out(number)
            self._spans[number] = span
            self._homes[number] = self._homes_of(span)
        for home in self._homes[number]:
            home[number] = extent

    def take_out(self, number: int) -> None:
        """Remove a box if it is there."""
        self._spans.pop(number, None)
        for home in self._homes.pop(number, ()):
            del home[number]

    def near(self, box: Aabb, reach_m: float = 0.0) -> list[int]:
        """Numbers of the boxes within ``reach_m`` of this one on every axis, in ascending order."""
        (low_x, low_y, low_z), (high_x, high_y, high_z) = box.low_m, box.high_m
        low_x, low_y, low_z = low_x - reach_m, low_y - reach_m, low_z - reach_m
        high_x, high_y, high_z = high_x + reach_m, high_y + reach_m, high_z + reach_m
        floor = math.floor
        span = floor(low_x / CELL_M), floor(low_y / CELL_M), floor(high_x / CELL_M), floor(high_y / CELL_M)
        found = [
            number
            for place in self._seen[span]
            for number, (a, b, c, d, e, f) in place.items()
            if c <= high_z and f >= low_z and a <= high_x and d >= low_x and b <= high_y and e >= low_y
        ]
        return sorted(set(found)) if len(found) > 1 else found

    def _find_places(self, span: Span) -> list[dict[int, Extent]]:
        """Buckets of a span; a box may be in several."""
        if _is_wide(span):
            return [self._wide, *self._cells.values()]
        return [self._wide, *(self._cells[cell] for cell in _cells_of(span) if cell in self._cells)]

    def _homes_of(self, span: Span) -> list[dict[int, Extent]]:
        if _is_wide(span):
            return [self._wide]
        count = len(self._cells)
        homes = [self._cells.setdefault(cell, {}) for cell in _cells_of(span)]
        if len(self._cells) != count:
            self._seen.clear()
        return homes


def _is_wide(span: Span) -> bool:
    first_i, first_j, last_i, last_j = span
    return (last_i - first_i + 1) * (last_j - first_j + 1) > WIDE_CELLS


def _cells_of(span: Span) -> Iterator[Cell]:
    first_i, first_j, last_i, last_j = span
    return itertools.product(range(first_i, last_i + 1), range(first_j, last_j + 1))
