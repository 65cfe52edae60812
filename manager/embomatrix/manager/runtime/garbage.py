"""Schedule of garbage collections: a full one takes 70 ms with 4,096 rollouts in flight."""

from __future__ import annotations

import gc
from typing import Final

YOUNG: Final = 5_000
"""Objects allocated between two collections of the youngest generation, which take 2 ms."""
MIDDLE: Final = 0
"""Every second collection includes the middle generation. With four times the interval and twice the size, a
collection takes 20 ms in which nothing else runs."""
NEVER: Final = 1_000_000
LONGEST_S: Final = 600.0
"""A full collection runs at least this often, even without an idle moment."""


class Collector:
    """Schedules full collections for moments without rollouts in flight. Times are of one monotonic clock."""

    def __init__(self, now_s: float) -> None:
        self._collected_s = now_s
        self._worked = False

    def note(self, in_flight: int, now_s: float) -> bool:
        """Return True if a full collection is due now, with this many rollouts in flight."""
        quiet = not in_flight and self._worked
        self._worked = in_flight > 0
        if quiet or now_s - self._collected_s >= LONGEST_S:
            self._collected_s = now_s
            return True
        return False


def only_young() -> None:
    """Freeze all present objects, and let the interpreter collect young generations only."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG, MIDDLE, NEVER)
