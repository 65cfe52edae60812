"""Wall-clock seconds of a run by activity."""

import contextlib
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum


class Activity(StrEnum):
    ORACLE = "the oracle's episodes"
    IMITATION = "imitation"
    EVALUATION = "evaluation"
    SAMPLING = "sampling"
    WAITING = "waiting for simulation"
    UPDATE = "update"
    SAVING = "saving"
    PUBLISHING = "sending weights to the model server"


@dataclass(frozen=True, slots=True)
class TimeShares:
    """Shares of GRPO's ``seconds``, from the seconds by activity. NaN if ``seconds`` is 0."""

    seconds: float
    spent_s: Mapping[str, float]

    @property
    def waiting(self) -> float:
        """Share in which the trainer was idle because it waited for simulation."""
        return self._share_of(Activity.WAITING)

    @property
    def overhead(self) -> float:
        """Share outside of sampling and updates."""
        return 1.0 - self._share_of(Activity.SAMPLING) - self._share_of(Activity.UPDATE)

    def _share_of(self, activity: Activity) -> float:
        return self.spent_s.get(activity.value, 0.0) / self.seconds if self.seconds else math.nan


class Stopwatch:
    """Sum of the seconds in ``track`` blocks, by activity. The blocks must not nest."""

    def __init__(self) -> None:
        self.spent_s: dict[str, float] = {}

    @contextlib.contextmanager
    def discard_on_error(self) -> Iterator[None]:
        """Count the block's seconds only if the block finishes."""
        before = dict(self.spent_s)
        try:
            yield
        except BaseException:
            self.spent_s = before
            raise

    def move(self, seconds: float, source: Activity, target: Activity) -> None:
        """Count seconds of one activity as those of another. The block of the former may still run."""
        for activity, change in ((source, -seconds), (target, seconds)):
            self.spent_s[activity.value] = self.spent_s.get(activity.value, 0.0) + change

    @contextlib.contextmanager
    def track(self, activity: Activity) -> Iterator[None]:
        began_s = time.monotonic()
        try:
            yield
        finally:
            spent_s = time.monotonic() - began_s
            self.spent_s[activity.value] = self.spent_s.get(activity.value, 0.0) + spent_s
