"""RRT-Connect: path search with two trees that grow from both ends until they meet.

Kuffner and LaValle, "RRT-Connect: an efficient approach to single-query path planning", 2000. A branch grows along the
straight line to a drawn posture as far as that is free.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from embomatrix.world.geometry import FloatArray

FreeUpTo = Callable[[FloatArray, FloatArray], FloatArray]
"""Farthest free posture on the straight line from one posture to another, each of shape (k,)."""

SHORTER_TRIES: Final = 12
"""Pairs of corners to try to join when a path is shortened."""


class _Tree:
    """Free postures with their predecessors."""

    def __init__(self, root: FloatArray, spacing: FloatArray) -> None:
        self._spacing = spacing
        self._nodes = [root]
        self._scaled = (root / spacing)[None]
        self._before = [-1]

    def grow(self, towards: FloatArray, free_up_to: FreeUpTo) -> int | None:
        """Grow from the nearest posture towards another. Return the new index, None without progress."""
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
        path = []
        while number >= 0:
            path.append(self._nodes[number])
            number = self._before[number]
        return path


def path_between(
    start: FloatArray, goal: FloatArray, draws: FloatArray, spacing: FloatArray, free_up_to: FreeUpTo
) -> FloatArray | None:
    """Return postures, (w, k), on a free path between two, None if the trees do not meet.

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


def _shortened(path: FloatArray, free_up_to: FreeUpTo) -> FloatArray:
    """Return the path without unnecessary corners."""
    first, tries = 0, 0
    while first < len(path) - 2 and tries < SHORTER_TRIES:
        for last in range(len(path) - 1, first + 1, -1):
            tries += 1
            if np.array_equal(free_up_to(path[first], path[last]), path[last]):
                path = np.concatenate([path[: first + 1], path[last:]])
                break
        first += 1
    return path
