"""Training reports to the manager, for its dashboard."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.wire.training import (
    FIGURES,
    NAME_CHARS,
    RewardTiers,
    SampledPlan,
    SampledStep,
    SampledTurn,
    TrainingReport,
)
from embomatrix.skills.parse import plan_to_lines
from embomatrix.trainer.grpo.records import GroupLog
from embomatrix.trainer.logging.trackers import GRPO_PHASE

if TYPE_CHECKING:
    from embomatrix.trainer.cluster.gateway import PlanOutcome

PLANS_SHOWN: Final = 4
"""Plans per step: from the group with the widest spread of rewards, from the best to the worst."""


class DashboardReporter:
    """Tracker that reports to the manager. ``send`` queues a report and never blocks."""

    def __init__(self, send: Callable[[TrainingReport], None]) -> None:
        self._send = send

    def log(self, phase: str, step: int, values: Mapping[str, float]) -> None:
        """Report a step's finite numbers."""
        finite = [(name[:NAME_CHARS], value) for name, value in values.items() if math.isfinite(value)]
        self._send(TrainingReport(phase, step, dict(finite[:FIGURES])))

    def close(self) -> None:
        """No-op: the gateway sends the remaining reports."""

    def sampled(self, step: int, logs: Sequence[GroupLog]) -> None:
        """Report some plans of a GRPO step."""
        widest = max(logs, key=_spread, default=None)
        self._send(TrainingReport(GRPO_PHASE, step, {}, () if widest is None else _plans(widest)))


def _spread(log: GroupLog) -> float:
    known = [outcome.value for outcome in log.outcomes if outcome.reward is not None]
    return max(known) - min(known) if known else -1.0


def _plans(log: GroupLog) -> tuple[SampledPlan, ...]:
    """Pick plans evenly by reward rank, including the best and the worst. Lost ones rank last."""
    ranked = sorted(
        zip(log.outcomes, log.advantages, strict=True),
        key=lambda pair: -math.inf if pair[0].reward is None else pair[0].value,
        reverse=True,
    )
    last = min(PLANS_SHOWN, len(ranked)) - 1
    chosen = [round(rank * (len(ranked) - 1) / max(last, 1)) for rank in range(last + 1)]
    return tuple(_plan(log, *ranked[rank]) for rank in chosen)


def _plan(log: GroupLog, outcome: PlanOutcome, advantage: float) -> SampledPlan:
    task, reward = log.task.task, outcome.reward
    tiers = None
    if reward is not None:
        tiers = RewardTiers(reward.format, reward.relevance, reward.goal, reward.success)
    steps = tuple(
        SampledStep(step.call.skill.value, step.ok, step.message, plan_to_lines((step.call,)))
        for step in outcome.steps
    )
    sampled = SampledPlan(
        task_id=task.task_id,
        instruction=task.instruction,
        text=outcome.text,
        reward=tiers,
        advantage=advantage if math.isfinite(advantage) else 0.0,
        problem=outcome.problem or outcome.lost,
        steps=steps,
    )
    if outcome.transcript is None:
        return sampled
    turns = tuple(SampledTurn(turn.answer, turn.observation, turn.steps) for turn in outcome.transcript.turns)
    return replace(sampled, turns=turns, opening=outcome.transcript.opening, end=outcome.transcript.end)
