"""Where the time goes: seconds of wall clock by activity."""

from __future__ import annotations

import contextlib
import math
import time
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping


class Activity(StrEnum):
    IMITATION = "imitation"
    EVALUATION = "evaluation"
    SAMPLING = "sampling"
    WAITING = "waiting for simulation"
    UPDATE = "update"
    SAVING = "saving"


@dataclass(frozen=True, slots=True)
class TimeShares:
    """Where the time of GRPO's steps went: ``seconds`` in all, of which ``spent_s`` tells parts by activity. NaN of no time."""

    seconds: float
    spent_s: Mapping[str, float]

    @property
    def waiting(self) -> float:
        """Share in which the trainer stood still for simulation."""
        return self._of(Activity.WAITING)

    @property
    def overhead(self) -> float:
        """Share in which the model neither sampled nor learnt: waiting and all that is around it."""
        return 1.0 - self._of(Activity.SAMPLING) - self._of(Activity.UPDATE)

    def _of(self, activity: Activity) -> float:
        return self.spent_s.get(activity.value, 0.0) / self.seconds if self.seconds else math.nan


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
