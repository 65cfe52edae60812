"""Simulated time: what shall happen, in order of its time, and of its entry where times are equal."""

from __future__ import annotations

import heapq
import itertools
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Agenda:
    """``now_s`` is the time of what happens now; seconds since the simulation began."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.happened = 0
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        """Have this happen in so many seconds, at the earliest now."""
        heapq.heappush(self._due, (self.now_s + max(delay_s, 0.0), next(self._order), action))

    def run(self, *, until: Callable[[], bool], limit_s: float) -> bool:
        """Let things happen until the condition holds; False when ``limit_s`` comes first, or nothing is left."""
        while not until():
            if not self._due or self._due[0][0] > limit_s:
                return False
            self.now_s, _, action = heapq.heappop(self._due)
            self.happened += 1
            action()
        return True
