"""Remaining time of a whole run, from the phases so far and from typical times of the word-level policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

GUESS_AFTER_S: Final = 5.0
"""Seconds of a phase after which its own speed is used, if it also got far enough."""
GUESS_AFTER_SHARE: Final = 0.05
"""Share of a phase after which its own speed is used: its first steps are slow, because processes and scenes get warm."""


class Phase(StrEnum):
    """Phases of a run. All evaluations together are one."""

    IMITATION = "imitation"
    GRPO = "GRPO"
    EVALUATION = "evaluation"


@dataclass(slots=True)
class PhaseTime:
    """Time of one phase. ``share`` is done; ``typical_s`` is the typical time of the whole phase, None if there is none.

    A phase with a ``budget_s`` takes that time on any machine.
    """

    typical_s: float | None = None
    budget_s: float | None = None
    share: float = 0.0
    began_at: float = field(init=False)
    spent_s: float = 0.0

    def __post_init__(self) -> None:
        self.began_at = self.share

    @property
    def is_measured(self) -> bool:
        return self.spent_s >= GUESS_AFTER_S and self.share - self.began_at >= GUESS_AFTER_SHARE

    def left_s(self, slowness: float | None) -> float | None:
        """Return the seconds that the phase still takes, None if nothing is known about its speed.

        ``slowness`` is the measured time of other phases as a multiple of their typical time.
        """
        left = max(0.0, 1.0 - self.share)
        if left == 0.0:
            return 0.0
        if self.budget_s is not None:
            return self.budget_s * left
        if self.is_measured:
            return self.spent_s / (self.share - self.began_at) * left
        return None if self.typical_s is None or slowness is None else self.typical_s * slowness * left


class RunClock:
    """Clock of one run that began at ``began_s``.

    Each report counts the time since the last one for its phase. ``samples`` are the plans per task by the label of an
    evaluation, ``plans`` those of all evaluations. ``warn_after_s``: time of the run after which ``is_late`` is true once.
    """

    def __init__(
        self,
        phases: Mapping[Phase, PhaseTime],
        *,
        began_s: float,
        samples: Mapping[str, int] | None = None,
        plans: int = 0,
        warn_after_s: float | None = None,
    ) -> None:
        self._phases = phases
        self._began_s = self._noted_s = began_s
        self._samples = samples or {}
        self._plans = plans
        self._tasks_done = 0
        self._warn_after_s = warn_after_s

    def note(self, phase: Phase, share: float, now_s: float) -> None:
        """Note that a phase has reached this share."""
        if phase in self._phases:
            self._phases[phase].spent_s += now_s - self._noted_s
            self._phases[phase].share = share
        self._noted_s = now_s

    def note_evaluation(self, label: str, done: int, total: int, now_s: float) -> None:
        """Note that one evaluation has ``done`` of its ``total`` tasks."""
        new = done - self._tasks_done
        self._tasks_done = done if done < total else 0
        if Phase.EVALUATION in self._phases:
            share = self._phases[Phase.EVALUATION].share + new * self._samples.get(label, 0) / max(
                1, self._plans
            )
            self.note(Phase.EVALUATION, min(1.0, share), now_s)

    def left_s(self) -> float | None:
        """Return the seconds that the run still takes, None if the speed of a phase is unknown."""
        known = [each for each in self._phases.values() if each.is_measured and each.typical_s is not None]
        typical_s = sum((each.typical_s or 0.0) * (each.share - each.began_at) for each in known)
        slowness = sum(each.spent_s for each in known) / typical_s if typical_s else None
        times = [each.left_s(slowness) for each in self._phases.values()]
        return None if None in times else sum(each for each in times if each is not None)

    def is_late(self, now_s: float) -> bool:
        """True at the first question after ``warn_after_s``."""
        if self._warn_after_s is None or now_s - self._began_s < self._warn_after_s:
            return False
        self._warn_after_s = None
        return True
