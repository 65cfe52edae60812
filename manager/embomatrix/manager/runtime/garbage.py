"""When the manager's garbage is collected: a look at everything that is alive takes 70 ms with 4,096 rollouts in flight."""

from __future__ import annotations

import gc
from typing import Final

YOUNG: Final = 5_000
"""Objects that are made before the youngest are looked at: two milliseconds."""
MIDDLE: Final = 0
"""Every second look takes in those that outlived the one before, and what outlives that as well is left alone. After more looks
there would be more to go through at once: 20 ms after four of twice the size, and nothing else is done meanwhile."""
NEVER: Final = 1_000_000
LONGEST_S: Final = 600.0
"""Without a quiet moment everything is looked at this often all the same."""


class Collector:
    """Collects everything while nothing is in flight, when nobody waits for it. Times are of one monotonic clock."""

    def __init__(self, now_s: float) -> None:
        self._collected_s = now_s
        self._worked = False

    def note(self, in_flight: int, now_s: float) -> bool:
        """So many rollouts are in flight; tells whether everything is to be collected now."""
        quiet = not in_flight and self._worked
        self._worked = in_flight > 0
        if quiet or now_s - self._collected_s >= LONGEST_S:
            self._collected_s = now_s
            return True
        return False


def only_young() -> None:
    """Have the interpreter collect what is short-lived by itself, and nothing else. What is alive now is for good."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG, MIDDLE, NEVER)
