"""Exponential backoff between retries, with jitter so that many clients do not return at the same moment."""

from collections.abc import Callable
from dataclasses import dataclass


def _no_jitter() -> float:
    return 1.0


@dataclass(slots=True)
class Backoff:
    """Waits that double from ``first_s`` to ``longest_s`` seconds; each is multiplied by ``jitter()``."""

    first_s: float
    longest_s: float
    jitter: Callable[[], float] = _no_jitter
    _attempts: int = 0

    def next_s(self) -> float:
        """Return the seconds to wait before the next attempt."""
        wait_s = min(self.longest_s, self.first_s * 2.0 ** min(self._attempts, 30))
        self._attempts += 1
        return wait_s * self.jitter()

    def reset(self) -> None:
        """Start again from the first wait, after a success."""
        self._attempts = 0
