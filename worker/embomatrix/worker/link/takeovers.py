"""Two daemons of one name take the session from each other: noticed, so that it does not go on for ever."""

from __future__ import annotations

from typing import Final

TAKEOVERS_ALLOWED: Final = 3
"""After so many takeovers within a minute, another daemon evidently bears the same name."""
TAKEOVER_WINDOW_S: Final = 60.0


class Takeovers:
    """Counts how often the session was taken over of late."""

    def __init__(self) -> None:
        self._at_s: list[float] = []

    def add(self, now_s: float) -> bool:
        """Note one more; whether these are too many to be an accident."""
        self._at_s = [at_s for at_s in self._at_s if now_s - at_s < TAKEOVER_WINDOW_S] + [now_s]
        return len(self._at_s) > TAKEOVERS_ALLOWED
