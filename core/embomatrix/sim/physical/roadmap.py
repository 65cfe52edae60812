"""Ways of the arm through free postures: two trees that grow from both ends until they meet.

Kuffner and LaValle, "RRT-Connect: an efficient approach to single-query path planning", 2000. A branch grows as far as the
straight way to where it is drawn is free.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.world.geometry import FloatArray

    FreeUpTo = Callable[[FloatArray, FloatArray], FloatArray]
    """The farthest free posture on the straight way from one posture to another, each of shape (k,)."""

SHORTER_TRIES: Final = 12
"""Pairs of corners of a way that are tried to be joined, to make it shorter."""


class _Tree:
    """Free postures, each with the one that it was reached from."""

    def __init__(self, root: FloatArray, spacing: FloatArray) -> None:
        self._spacing = spacing
        self._nodes = [root]
        self._scaled = (root / spacing)[None]
        self._before = [-1]

    def grow(self, towards: FloatArray, free_up_to: FreeUpTo) -> int | None:
        """Grow from the nearest posture towards another. Returns the new number, None where nothing was gained."""
        nearest = int(np.abs(self._scaled - towards / self._spacing).max(axis=1).argmin())
        reached = free_up_to(self._nodes[nearest], towards)
        if np.array_equal(reached, self._nodes[nearest]):
            return None
        self._nodes.append(reached)
        self._scaled = np.concatenate([self._scaled, (reached / self._spacing)[None]])
        self._before.append(nearest)
        return len(self._nodes) - 1

    def node(self, number: int) -> FloatArray:
        return self._nodes[number]

    def back_to_root(self, number: int) -> list[FloatArray]:
        way = []
        while number >= 0:
            way.append(self._nodes[number])
            number = self._before[number]
        return way


def way_between(
    start: FloatArray, goal: FloatArray, draws: FloatArray, spacing: FloatArray, free_up_to: FreeUpTo
) -> FloatArray | None:
    """Postures, (w, k), on a free way between two, None when the trees do not meet.

    draws: (n, k) postures towards which the trees grow, in this order. Distances are in units of ``spacing``, (k,).
    """
    if np.array_equal(free_up_to(start, goal), goal):
        return np.stack([start, goal])
    trees = (_Tree(start, spacing), _Tree(goal, spacing))
    for number, draw in enumerate(draws):
        one, other = trees[number % 2], trees[1 - number % 2]
        grown = one.grow(draw, free_up_to)
        if grown is None:
            continue
        met = other.grow(one.node(grown), free_up_to)
        if met is not None and np.array_equal(other.node(met), one.node(grown)):
            halves = [one.back_to_root(grown), other.back_to_root(met)]
            ahead, back = halves if number % 2 == 0 else halves[::-1]
            return _shortened(np.array([*ahead[::-1], *back[1:]]), free_up_to)
    return None


def _shortened(way: FloatArray, free_up_to: FreeUpTo) -> FloatArray:
    """The way without corners that it does not need."""
    first, tries = 0, 0
    while first < len(way) - 2 and tries < SHORTER_TRIES:
        for last in range(len(way) - 1, first + 1, -1):
            tries += 1
            if np.array_equal(free_up_to(way[first], way[last]), way[last]):
                way = np.concatenate([way[: first + 1], way[last:]])
                break
        first += 1
    return way
