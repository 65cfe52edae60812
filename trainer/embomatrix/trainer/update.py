"""One optimiser step of GRPO, with simulation hidden behind sampling and back-propagation.

Chunks of tasks are sampled one after the other; each chunk's plans go to the cluster at once. Chunks are back-propagated in
the order of sampling as soon as their rewards are there, with one optimiser step at the end: the gradient is that of the
whole batch, on-policy, and does not depend on which worker was faster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from embomatrix.rpc.values import Completed
from embomatrix.trainer.grpo import LossMetrics, Scale, Terms, group_advantages, surrogate_loss
from embomatrix.trainer.rollout import waited
from embomatrix.trainer.settings import OnLost
from embomatrix.trainer.stopwatch import Activity

if TYPE_CHECKING:
    from collections.abc import Sequence
    from concurrent.futures import Future

    import numpy as np

    from embomatrix.trainer.data import TrainingTask
    from embomatrix.trainer.policy.protocol import Policy, Samples
    from embomatrix.trainer.rollout import Gateway, PlanOutcome
    from embomatrix.trainer.settings import GrpoSettings
    from embomatrix.trainer.stopwatch import Stopwatch
    from embomatrix.trainer.telling import Teller, Told


@dataclass(frozen=True, slots=True)
class StepRecord:
    """What one step did. Rates are over rollouts that have a result; token means over the plans that moved the policy."""

    step: int
    reward: float
    success: float
    well_formed: float
    plan_steps: float
    dead_groups: float
    entropy: float
    kl: float
    clipped: float
    gradient_norm: float
    learning_rate: float
    rollouts: int
    lost: int
    warm: float


@dataclass(frozen=True, slots=True)
class GroupLog:
    """One task's plans of a step, for the sample log."""

    task: TrainingTask
    outcomes: tuple[PlanOutcome, ...]
    advantages: tuple[float, ...]


@dataclass(slots=True)
class _Chunk:
    tasks: Sequence[TrainingTask]
    told: Sequence[Told]
    samples: Samples
    futures: list[Future[tuple[PlanOutcome, ...]]]
    reference: torch.Tensor | None = None


class Updater:
    """Takes steps on one policy."""

    def __init__(
        self,
        policy: Policy,
        reference: Policy,
        teller: Teller,
        gateway: Gateway,
        settings: GrpoSettings,
        stopwatch: Stopwatch,
    ) -> None:
        self._policy = policy
        self._reference = reference
        self._teller = teller
        self._gateway = gateway
        self._settings = settings
        self._stopwatch = stopwatch
        self.optimiser = torch.optim.AdamW(
            policy.parameters(), lr=settings.learning_rate, betas=(0.9, 0.95), weight_decay=0.0
        )

    def take_step(
        self,
        step: int,
        tasks: Sequence[TrainingTask],
        rng: np.random.Generator,
        generator: torch.Generator,
        rate_factor: float,
    ) -> tuple[StepRecord, list[GroupLog]]:
        """Sample, execute and learn from one batch of tasks; ``rate_factor`` scales the learning rate."""
        settings = self._settings
        with self._stopwatch.spending(Activity.SAMPLING):
            chunks = [
                self._sample(f"{step}-{number}", step, tasks[at : at + settings.chunk], rng, generator)
                for number, at in enumerate(range(0, len(tasks), settings.chunk))
            ]
        with self._stopwatch.spending(Activity.UPDATE):
            for chunk in chunks:
                chunk.reference = self._reference_logprobs(chunk)
        scale = Scale(
            plans=sum(chunk.samples.mask.shape[0] for chunk in chunks),
            tokens=sum(int(chunk.samples.mask.sum()) for chunk in chunks),
        )
        rate = settings.learning_rate * rate_factor
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad(set_to_none=True)
        logs: list[GroupLog] = []
        metrics: list[LossMetrics] = []
        for chunk in chunks:
            with self._stopwatch.spending(Activity.WAITING):
                outcomes = [waited(future) for future in chunk.futures]
            with self._stopwatch.spending(Activity.UPDATE):
                logs += self._learn(chunk, outcomes, scale, metrics)
        with self._stopwatch.spending(Activity.UPDATE):
            norm = self._apply(metrics)
        return _record(step, logs, metrics, norm, rate), logs

    def _sample(
        self,
        label: str,
        step: int,
        tasks: Sequence[TrainingTask],
        rng: np.random.Generator,
        generator: torch.Generator,
    ) -> _Chunk:
        settings = self._settings
        told = [self._teller.anew(task, rng) for task in tasks]
        samples = self._policy.sample(
            [each.prompt for each in told], settings.group, settings.temperature, settings.max_new, generator
        )
        futures = [
            self._gateway.submit(
                f"step-{label}-{row}",
                step,
                task,
                each.situation,
                samples.texts[row * settings.group : (row + 1) * settings.group],
                self._policy.codec,
            )
            for row, (task, each) in enumerate(zip(tasks, told, strict=True))
        ]
        return _Chunk(tasks, told, samples, futures)

    @torch.no_grad()
    def _reference_logprobs(self, chunk: _Chunk) -> torch.Tensor | None:
        """Computed while the cluster works: it needs no reward."""
        if self._settings.kl_coef == 0:
            return None
        return self._reference.logprobs(
            [each.prompt for each in chunk.told],
            chunk.samples.tokens,
            chunk.samples.mask,
            self._settings.group,
            self._settings.temperature,
        ).logprobs

    def _learn(
        self,
        chunk: _Chunk,
        outcomes: list[tuple[PlanOutcome, ...]],
        scale: Scale,
        metrics: list[LossMetrics],
    ) -> list[GroupLog]:
        """Back-propagate the groups of a chunk that carry a signal."""
        group = self._settings.group
        rewards = torch.tensor([[outcome.value for outcome in each] for each in outcomes])  # (tasks, G)
        if self._settings.on_lost is OnLost.GROUP:
            rewards[torch.isnan(rewards).any(dim=1)] = math.nan
        advantages = group_advantages(rewards)
        live = [row for row, dead in enumerate(advantages.dead.tolist()) if not dead]
        if live:
            rows = torch.tensor([row * group + sample for row in live for sample in range(group)])
            known = ~torch.isnan(rewards[live].view(-1))
            samples = chunk.samples
            rows = rows.to(samples.tokens.device)
            length = int(samples.mask[rows].sum(dim=1).max())
            mask = samples.mask[rows, :length] & known.to(rows.device)[:, None]
            tokens = samples.tokens[rows, :length]
            prompts = [chunk.told[row].prompt for row in live]
            scored = self._policy.logprobs(prompts, tokens, mask, group, self._settings.temperature)
            terms = Terms(
                logprobs=scored.logprobs,
                old_logprobs=samples.logprobs[rows, :length],
                mask=mask,
                advantages=advantages.values[live].view(-1).to(rows.device),
                reference=None if chunk.reference is None else chunk.reference[rows, :length],
                entropy=scored.entropy,
            )
            loss, parts = surrogate_loss(terms, self._settings.objective(), scale)
            loss.backward()  # type: ignore[no-untyped-call]
            metrics.append(parts)
        return [
            GroupLog(task, each, tuple(values))
            for task, each, values in zip(chunk.tasks, outcomes, advantages.values.tolist(), strict=True)
        ]

    def _apply(self, metrics: list[LossMetrics]) -> float:
        """Move the policy, unless nothing was learnt or the gradient is not finite."""
        if not metrics:
            return 0.0
        norm = float(torch.nn.utils.clip_grad_norm_(self._policy.parameters(), self._settings.max_grad_norm))
        if math.isfinite(norm):
            self.optimiser.step()
        return norm


def _record(
    step: int, logs: list[GroupLog], metrics: list[LossMetrics], norm: float, rate: float
) -> StepRecord:
    outcomes = [outcome for log in logs for outcome in log.outcomes]
    known = [outcome for outcome in outcomes if outcome.reward is not None]
    executed = [outcome.outcome for outcome in known if isinstance(outcome.outcome, Completed)]
    weight = sum(part.weight for part in metrics) or 1

    def over_tokens(name: str) -> float:
        return float(sum(getattr(part, name) * part.weight for part in metrics) / weight)

    return StepRecord(
        step=step,
        reward=_mean([outcome.value for outcome in known]),
        success=_mean([outcome.success for outcome in known]),
        well_formed=_mean([not outcome.problem for outcome in known]),
        plan_steps=_mean([len(outcome.steps) for outcome in executed]),
        dead_groups=_mean([not any(log.advantages) for log in logs]),
        entropy=over_tokens("entropy"),
        kl=over_tokens("kl_to_reference"),
        clipped=over_tokens("clip_fraction"),
        gradient_norm=norm,
        learning_rate=rate,
        rollouts=len(outcomes),
        lost=len(outcomes) - len(known),
        warm=_mean([outcome.warm for outcome in executed]),
    )


def _mean(values: Sequence[float]) -> float:
    return float(sum(values) / len(values)) if values else 0.0
