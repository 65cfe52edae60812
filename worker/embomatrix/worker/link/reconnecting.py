"""Reconnecting: waits between attempts, and repeated session conflicts of two workers with one name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import numpy as np

CONFLICTS_ALLOWED: Final = 3
"""More session conflicts than this within the window mean that another worker has the same name."""
CONFLICT_WINDOW_S: Final = 60.0


@dataclass(slots=True)
class Backoff:
    """Waits that double from ``first_s`` to ``longest_s`` seconds, each with a jitter of 20 % to both sides."""

    rng: np.random.Generator
    longest_s: float
    first_s: float = 0.2
    _attempts: int = 0

    def next_s(self) -> float:
        """Seconds to wait before the next attempt."""
        wait_s = min(self.longest_s, self.first_s * 2 ** min(self._attempts, 30))
        self._attempts += 1
        return float(wait_s * self.rng.uniform(0.8, 1.2))

    def reset(self) -> None:
        """Start over after a success."""
        self._attempts = 0


class SessionConflicts:
    """Times at which another worker of the same name took the session over."""

    def __init__(self) -> None:
        self._at_s: list[float] = []

    def add(self, now_s: float) -> bool:
        """Record a conflict; return whether there were too many within the window."""
        self._at_s = [at_s for at_s in self._at_s if now_s - at_s < CONFLICT_WINDOW_S] + [now_s]
        return len(self._at_s) > CONFLICTS_ALLOWED
