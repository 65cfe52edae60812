"""Connected components of a floor's free cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int16]

Window = tuple[slice, slice]


@dataclass(frozen=True, slots=True)
class FloorParts:
    """Component number of each free cell, 0 for the others.

    A change on the floor renumbers a window; the other numbers are shared with the previous floor.
    """

    whole: IntArray
    """Numbers of all cells, shape (rows, columns), before the window was renumbered."""
    count: int
    """Upper bound of the numbers."""
    window: Window = (slice(0, 0), slice(0, 0))
    inner: IntArray | None = None
    """Numbers of the window's cells."""

    @staticmethod
    def of(free: BoolArray) -> FloorParts:
        """Components of the free cells, connected by their sides."""
        return FloorParts(*_numbered(free))

    @property
    def numbers(self) -> IntArray:
        """Numbers of all cells, shape (rows, columns). Read-only."""
        if self.inner is None:
            return self.whole
        numbers = self.whole.copy()
        numbers[self.window] = self.inner
        return numbers

    def at(self, cell: tuple[int, int]) -> int:
        """Number of one cell."""
        (i, j), (rows, columns) = cell, self.window
        if self.inner is not None and rows.start <= i < rows.stop and columns.start <= j < columns.stop:
            return int(self.inner[i - rows.start, j - columns.start])
        return int(self.whole[cell])

    def within(self, window: Window) -> IntArray:
        """Numbers of a window's cells. Read-only."""
        numbers = self.whole[window]
        if self.inner is None:
            return numbers
        here, there = overlap(window, self.window)
        numbers = numbers.copy()
        numbers[here] = self.inner[there]
        return numbers

    def largest_in(self, before: FloorParts, number: int) -> int:
        """Largest component within the one that had this number before the last changes; 0 if nothing of it is left."""
        if self.inner is None or self.whole is not before.whole:
            sizes = np.bincount(self.numbers[before.numbers == number], minlength=1)
        else:
            # Nothing has changed beyond the window: a house with a garden has half a million cells.
            window = self.window if before.inner is None else _around(self.window, before.window)
            was = before.within(window) == number
            sizes = np.bincount(self.within(window)[was], minlength=number + 1)
            sizes[number] += before._count_of(number) - np.count_nonzero(was)
        sizes[0] = 0
        return int(sizes.argmax())

    def _count_of(self, number: int) -> int:
        """Number of cells of a component."""
        count = np.count_nonzero(self.whole == number)
        if self.inner is not None:
            before = np.count_nonzero(self.whole[self.window] == number)
            count += np.count_nonzero(self.inner == number) - before
        return int(count)

    def changed(self, free: BoolArray, window: Window) -> FloorParts:
        """Components after cells of a window changed: ``free`` are the window's; its edge is unchanged.

        If the edge cells connect within the window as before, so do all cells beyond it.
        """
        old = self.within(window)
        before, _ = _numbered(old > 0)
        after, found = _numbered(free)
        edge = np.ones(after.shape, dtype=np.bool_)
        edge[1:-1, 1:-1] = False
        pairs = set(zip(before[edge].tolist(), after[edge].tolist(), strict=True))
        if not len(pairs) == len({first for first, _ in pairs}) == len({last for _, last in pairs}):
            everywhere = self.numbers > 0
            everywhere[window] = free
            return FloorParts.of(everywhere)
        # A component away from the edge is separate from all others.
        names = np.arange(self.count, self.count + found + 1, dtype=np.int16)
        names[0] = 0
        names[after[edge]] = old[edge]
        inner, both = names[after], window
        if self.inner is not None:
            both = _around(self.window, window)
            inner = self.within(both).copy()
            inner[overlap(both, window)[0]] = names[after]
        return FloorParts(self.whole, self.count + found, both, inner)


def _numbered(free: NDArray[Any]) -> tuple[IntArray, int]:
    numbers, count = ndimage.label(free, output=np.int16)
    return np.asarray(numbers), int(count)


def overlap(first: Window, second: Window) -> tuple[Window, Window]:
    """Cells that two windows share, relative to each one's corner; empty slices for none."""
    low = [max(a.start, b.start) for a, b in zip(first, second, strict=True)]
    high = [max(start, min(a.stop, b.stop)) for start, a, b in zip(low, first, second, strict=True)]
    return _seen_from(first, low, high), _seen_from(second, low, high)


def _around(first: Window, second: Window) -> Window:
    """Smallest window around both."""
    rows, columns = (
        slice(min(a.start, b.start), max(a.stop, b.stop)) for a, b in zip(first, second, strict=True)
    )
    return rows, columns


def _seen_from(window: Window, low: list[int], high: list[int]) -> Window:
    rows, columns = window
    return slice(low[0] - rows.start, high[0] - rows.start), slice(
        low[1] - columns.start, high[1] - columns.start
    )
