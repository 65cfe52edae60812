"""Waits between attempts: longer each time, with jitter, so that a thousand workers don't come back at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


@dataclass(slots=True)
class Backoff:
    """Doubles from ``first_s`` to ``longest_s`` seconds; each wait is spread by a fifth to both sides."""

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
        """An attempt succeeded."""
        self._attempts = 0
