"""Record of one GRPO step, for logs and displays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.rpc.wire.values import Completed

if TYPE_CHECKING:
    from embomatrix.trainer.cluster.gateway import PlanOutcome
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.learning.objective import LossMetrics


@dataclass(frozen=True, slots=True)
class StepRecord:
    """Metrics of one step.

    Rates are over rollouts with a result. Token means are over the plans that had a gradient, in all updates of the step,
    None if there were none. ``gradient_norm`` is the mean over the updates.
    ``reward_format``, ``reward_relevance`` and ``reward_goal`` are the means of the tiers and add up to ``reward``.
    ``kl`` is KL(policy || reference policy), None without a KL term; ``kl_to_old`` is KL(policy that sampled || policy).
    ``sampler_gap`` and ``sampler_gap_max`` are mean and maximum of the difference in nats between the log-probabilities of
    sampling and those of the policy at the beginning of the step, 0 if the policy itself sampled.
    """

    step: int
    reward: float
    reward_format: float
    reward_relevance: float
    reward_goal: float
    success: float
    success_by_category: Mapping[str, float]
    well_formed: float
    plan_steps: float
    zero_variance_groups: float
    groups: int
    entropy: float | None
    kl: float | None
    kl_to_old: float | None
    clipped: float | None
    sampler_gap: float | None
    sampler_gap_max: float | None
    gradient_norm: float
    learning_rate: float
    rollouts: int
    lost: int
    cut_off: float
    """Share of the plans that ``grpo.max_new`` cut off before their end token, or of the episodes that the context cut off."""
    warm: float | None
    shared: float | None
    """Share of the steps that were known from equal plans or equal beginnings and not executed.

    Both are None in episodes, and if no plan was executed.
    """


@dataclass(frozen=True, slots=True)
class GroupLog:
    """One task's plans of a step. ``zero_variance``: equal rewards or too few of them, so all advantages are 0.

    ``cut_off`` counts the plans without an end token.
    """

    task: TrainingTask
    outcomes: tuple[PlanOutcome, ...]
    advantages: tuple[float, ...]
    zero_variance: bool
    cut_off: int


def record_of(
    step: int, logs: Sequence[GroupLog], metrics: Sequence[LossMetrics], norms: Sequence[float], rate: float
) -> StepRecord:
    """Summarise a step from its groups, the metrics of its microbatches, its gradient norms and the learning rate."""
    outcomes = [outcome for log in logs for outcome in log.outcomes]
    known = [outcome for outcome in outcomes if outcome.reward is not None]
    rewards = [outcome.reward for outcome in known if outcome.reward is not None]
    executed = [outcome.outcome for outcome in known if isinstance(outcome.outcome, Completed)]
    steps = sum(len(outcome.steps) for outcome in executed)
    weight = sum(part.weight for part in metrics)

    def over_tokens(name: str) -> float | None:
        values = [(getattr(part, name), part.weight) for part in metrics]
        if not weight or any(value is None for value, _ in values):
            return None
        return float(sum(value * tokens for value, tokens in values) / weight)

    return StepRecord(
        step=step,
        reward=_mean([outcome.value for outcome in known]),
        reward_format=_mean([reward.format for reward in rewards]),
        reward_relevance=_mean([reward.relevance for reward in rewards]),
        reward_goal=_mean([reward.goal for reward in rewards]),
        success=_mean([outcome.success for outcome in known]),
        success_by_category=_by_category(logs),
        well_formed=_mean([not outcome.problem for outcome in known]),
        plan_steps=_mean([len(outcome.steps) for outcome in known if not outcome.problem]),
        zero_variance_groups=_mean([log.zero_variance for log in logs]),
        groups=len(logs),
        entropy=over_tokens("entropy"),
        kl=over_tokens("kl_to_reference"),
        kl_to_old=over_tokens("kl_to_old"),
        clipped=over_tokens("clip_fraction"),
        sampler_gap=over_tokens("sampler_gap"),
        sampler_gap_max=max((part.sampler_gap_max for part in metrics), default=None),
        gradient_norm=_mean(norms),
        learning_rate=rate,
        rollouts=len(outcomes),
        lost=len(outcomes) - len(known),
        cut_off=sum(log.cut_off for log in logs) / max(1, len(outcomes)),
        warm=_mean([outcome.warm for outcome in executed]) if executed else None,
        shared=sum(outcome.shared_steps for outcome in executed) / max(1, steps) if executed else None,
    )


def _by_category(logs: Sequence[GroupLog]) -> dict[str, float]:
    successes: dict[str, list[float]] = {}
    for log in logs:
        found = successes.setdefault(log.task.task.category.value, [])
        found += [outcome.success for outcome in log.outcomes if outcome.reward is not None]
    return {category: _mean(values) for category, values in sorted(successes.items()) if values}


def _mean(values: Sequence[float]) -> float:
    return float(sum(values) / len(values)) if values else 0.0
