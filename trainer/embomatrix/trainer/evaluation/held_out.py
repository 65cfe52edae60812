"""How good a policy is: success on tasks that it never saw, with honest intervals.

Tasks are the unit of chance: samples of one task are not independent, so intervals come from a bootstrap over tasks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from embomatrix.trainer.cluster.gateway import waited
from embomatrix.trainer.evaluation.intervals import bootstrap

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from concurrent.futures import Future

    from embomatrix.trainer.cluster.gateway import Gateway, PlanOutcome
    from embomatrix.trainer.config.settings import EvaluationSettings
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.evaluation.intervals import Interval
    from embomatrix.trainer.policy.prompts import Teller
    from embomatrix.trainer.policy.protocol import Policy


@dataclass(frozen=True, slots=True)
class TaskScore:
    """One task's samples. ``lost`` rollouts count in neither ``samples`` nor ``successes``."""

    task_id: str
    category: str
    samples: int
    successes: int
    well_formed: int
    mean_reward: float
    lost: int

    @property
    def rate(self) -> float:
        return self.successes / self.samples if self.samples else float("nan")


@dataclass(frozen=True)
class HeldOutEvaluation:
    """Scores of every task, in the order of the tasks."""

    scores: tuple[TaskScore, ...]

    def success(self, category: str = "") -> Interval:
        """Mean success over tasks, of one category or of all."""
        return bootstrap([score.rate for score in self.scores if category in ("", score.category)])

    @property
    def categories(self) -> tuple[str, ...]:
        return tuple(sorted({score.category for score in self.scores}))

    @property
    def mean_reward(self) -> float:
        known = [score.mean_reward for score in self.scores if score.samples]
        return float(np.mean(known)) if known else float("nan")

    @property
    def well_formed(self) -> float:
        total = sum(score.samples for score in self.scores)
        return sum(score.well_formed for score in self.scores) / total if total else float("nan")

    def as_json(self) -> list[dict[str, Any]]:
        return [
            {name: getattr(score, name) for name in TaskScore.__dataclass_fields__} for score in self.scores
        ]

    @staticmethod
    def from_json(values: Sequence[Mapping[str, Any]]) -> HeldOutEvaluation:
        return HeldOutEvaluation(tuple(TaskScore(**value) for value in values))


def improvement(before: HeldOutEvaluation, after: HeldOutEvaluation) -> Interval:
    """Mean paired difference in success over the tasks that both evaluations hold."""
    earlier = {score.task_id: score.rate for score in before.scores}
    pairs = [score.rate - earlier[score.task_id] for score in after.scores if score.task_id in earlier]
    return bootstrap(pairs)


def evaluate_policy(
    policy: Policy,
    teller: Teller,
    tasks: Sequence[TrainingTask],
    gateway: Gateway,
    settings: EvaluationSettings,
    *,
    max_new: int,
    seed: int,
    label: str,
    report: Callable[[int, int], None],
) -> HeldOutEvaluation:
    """Sample ``settings.samples`` plans of every task and execute each once. ``report`` gets tasks done and in all."""
    device = next(iter(policy.parameters())).device
    generator = torch.Generator(device).manual_seed(seed)
    chunks = [tasks[at : at + settings.chunk] for at in range(0, len(tasks), settings.chunk)]
    gateway.announce(dict(enumerate(chunks)), settings.samples)
    pending: list[tuple[TrainingTask, Future[tuple[PlanOutcome, ...]]]] = []
    for number, chunk in enumerate(chunks):
        told = [teller.plainly(task) for task in chunk]
        prompts = [each.prompt for each in told]
        drawn = policy.sample(prompts, settings.samples, settings.temperature, max_new, generator)
        for row, (task, each) in enumerate(zip(chunk, told, strict=True)):
            texts = drawn.texts[row * settings.samples : (row + 1) * settings.samples]
            batch_id = f"{label}-{number}-{row}"
            pending.append(
                (task, gateway.submit(batch_id, number, task, each.situation, texts, policy.codec))
            )
    scores = []
    for task, future in pending:
        outcomes: tuple[PlanOutcome, ...] = waited(future)
        scores.append(_task_score(task, outcomes))
        report(len(scores), len(tasks))
    return HeldOutEvaluation(tuple(scores))


def _task_score(task: TrainingTask, outcomes: Sequence[PlanOutcome]) -> TaskScore:
    known = [outcome for outcome in outcomes if outcome.reward is not None]
    return TaskScore(
        task_id=task.task.task_id,
        category=task.task.category.value,
        samples=len(known),
        successes=sum(outcome.success for outcome in known),
        well_formed=sum(not outcome.problem for outcome in known),
        mean_reward=float(np.mean([outcome.value for outcome in known])) if known else float("nan"),
        lost=len(outcomes) - len(known),
    )
