"""Tells the manager how training goes, for people who look at its dashboard."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.wire.training import (
    FIGURES,
    NAME_CHARS,
    RewardTiers,
    SampledPlan,
    SampledStep,
    TrainingReport,
)
from embomatrix.rpc.wire.values import Cancelled, Completed, InfraFailure
from embomatrix.trainer.logging.trackers import GRPO_PHASE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from embomatrix.trainer.grpo.records import GroupLog
    from embomatrix.trainer.grpo.rollout import PlanOutcome

SHOWN: Final = 4
"""Plans of a step: of the group whose rewards differ most, from the best to the worst."""


class Reporter:
    """A tracker whose program is the manager. ``send`` takes a report and never waits for anything."""

    def __init__(self, send: Callable[[TrainingReport], None]) -> None:
        self._send = send

    def log(self, phase: str, step: int, values: Mapping[str, float]) -> None:
        """Numbers of a step; those that are not finite have nothing to show."""
        finite = [(name[:NAME_CHARS], value) for name, value in values.items() if math.isfinite(value)]
        self._send(TrainingReport(phase, step, dict(finite[:FIGURES])))

    def close(self) -> None:
        """Nothing stays open: the gateway sends what is left."""

    def sampled(self, step: int, logs: Sequence[GroupLog]) -> None:
        """Some plans of a step of GRPO."""
        widest = max(logs, key=_spread, default=None)
        self._send(TrainingReport(GRPO_PHASE, step, {}, () if widest is None else _plans(widest)))


def _spread(log: GroupLog) -> float:
    known = [outcome.value for outcome in log.outcomes if outcome.reward is not None]
    return max(known) - min(known) if known else -1.0


def _plans(log: GroupLog) -> tuple[SampledPlan, ...]:
    """Evenly from the ranks of the group, so that both ends are among them; what was lost comes last."""
    ranked = sorted(
        zip(log.outcomes, log.advantages, strict=True),
        key=lambda pair: -math.inf if pair[0].reward is None else pair[0].value,
        reverse=True,
    )
    last = min(SHOWN, len(ranked)) - 1
    chosen = [round(rank * (len(ranked) - 1) / max(last, 1)) for rank in range(last + 1)]
    return tuple(_plan(log, *ranked[rank]) for rank in chosen)


def _plan(log: GroupLog, outcome: PlanOutcome, advantage: float) -> SampledPlan:
    task, reward = log.task.task, outcome.reward
    tiers = None
    if reward is not None:
        tiers = RewardTiers(reward.format, reward.relevance, reward.goal, reward.success)
    problem = outcome.problem
    steps: tuple[SampledStep, ...] = ()
    match outcome.outcome:
        case Completed():
            steps = tuple(
                SampledStep(step.call.skill.value, step.ok, step.message) for step in outcome.outcome.steps
            )
        case InfraFailure(code=code, message=message):
            problem = f"{code.value}: {message}"
        case Cancelled():
            problem = "cancelled"
        case None:
            pass
    finite = advantage if math.isfinite(advantage) else 0.0
    return SampledPlan(task.task_id, task.instruction, outcome.text, tiers, finite, problem, steps)
