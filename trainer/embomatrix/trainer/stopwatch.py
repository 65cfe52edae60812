"""Where the time goes: seconds of wall clock by activity."""

from __future__ import annotations

import contextlib
import time
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


class Activity(StrEnum):
    IMITATION = "imitation"
    EVALUATION = "evaluation"
    SAMPLING = "sampling"
    WAITING = "waiting for simulation"
    UPDATE = "update"
    SAVING = "saving"


class Stopwatch:
    """Adds up what is spent in ``spending`` blocks, which do not nest."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.spent_s: dict[str, float] = {}

    @contextlib.contextmanager
    def whole(self) -> Iterator[None]:
        """Work that counts when it is done: what is spent in it is forgotten where it is broken off."""
        before = dict(self.spent_s)
        try:
            yield
        except BaseException:
            self.spent_s = before
            raise

    @contextlib.contextmanager
    def spending(self, activity: Activity) -> Iterator[None]:
        began_s = self._clock()
        try:
            yield
        finally:
            spent_s = self._clock() - began_s
            self.spent_s[activity.value] = self.spent_s.get(activity.value, 0.0) + spent_s
