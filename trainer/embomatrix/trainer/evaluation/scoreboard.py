"""Figures of an evaluation: success, partial credit and pass@k, overall and by category, and causes of failure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Final

from embomatrix.trainer.evaluation.intervals import Estimate, mean_over_tasks, pass_at
from embomatrix.trainer.evaluation.taxonomy import Cause
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict
from embomatrix.world.task import TaskCategory

KS: Final = (1, 2, 3, 5, 10, 20, 50, 100)
"""Values of k for pass@k, as far as there are samples."""


@dataclass(frozen=True)
class TaskResult:
    """Verdicts of one task by sample. Figures leave out lost plans."""

    task_id: str
    category: TaskCategory
    verdicts: tuple[AnswerVerdict, ...]

    @cached_property
    def known(self) -> tuple[AnswerVerdict, ...]:
        return tuple(verdict for verdict in self.verdicts if not verdict.lost)

    @property
    def successes(self) -> int:
        return sum(verdict.success for verdict in self.known)

    @property
    def rate(self) -> float:
        """Share of successful samples, NaN if unknown."""
        return self.successes / len(self.known) if self.known else math.nan

    @property
    def partial(self) -> float:
        """Mean share of the goal's atoms that hold at the end, NaN if unknown."""
        return sum(verdict.partial for verdict in self.known) / len(self.known) if self.known else math.nan


@dataclass(frozen=True)
class Scoreboard:
    """Results of all tasks in benchmark order. ``by_rule`` counts the tasks that can't be expressed and were not asked."""

    tasks: tuple[TaskResult, ...]
    by_rule: int = 0

    @staticmethod
    def of(
        tasks: Mapping[str, TaskCategory], verdicts: Sequence[AnswerVerdict], by_rule: int = 0
    ) -> Scoreboard:
        """Group verdicts by task. ``tasks`` maps all asked task ids to categories."""
        found: dict[str, list[AnswerVerdict]] = {task_id: [] for task_id in tasks}
        for verdict in verdicts:
            found[verdict.task_id].append(verdict)
        return Scoreboard(
            tuple(
                TaskResult(
                    task_id, category, tuple(sorted(found[task_id], key=lambda verdict: verdict.sample))
                )
                for task_id, category in tasks.items()
            ),
            by_rule,
        )

    @property
    def categories(self) -> tuple[TaskCategory, ...]:
        """Present categories, in the order of the paper's table."""
        present = {task.category for task in self.tasks}
        return tuple(category for category in TaskCategory if category in present)

    @cached_property
    def samples(self) -> int:
        return sum(len(task.verdicts) for task in self.tasks)

    @cached_property
    def lost(self) -> int:
        return sum(len(task.verdicts) - len(task.known) for task in self.tasks)

    def of_category(self, category: TaskCategory | None) -> tuple[TaskResult, ...]:
        """Tasks of a category; None: all tasks."""
        return tuple(task for task in self.tasks if category in (None, task.category))

    def success(self, category: TaskCategory | None = None) -> Estimate:
        """Mean success rate over tasks."""
        return mean_over_tasks([task.rate for task in self.of_category(category)])

    def success_over_all(self) -> Estimate:
        """Mean success rate, with inexpressible tasks as failures."""
        return mean_over_tasks([*(task.rate for task in self.tasks), *([0.0] * self.by_rule)])

    def partial(self, category: TaskCategory | None = None) -> Estimate:
        """Mean share of goal atoms that hold at the end, over tasks."""
        return mean_over_tasks([task.partial for task in self.of_category(category)])

    def pass_at(self, category: TaskCategory | None = None) -> dict[int, Estimate]:
        """Mean pass@k over tasks, by k."""
        tasks = self.of_category(category)
        most = max((len(task.known) for task in tasks), default=0)
        return {
            k: mean_over_tasks([pass_at(k, len(task.known), task.successes) for task in tasks])
            for k in KS
            if k <= most
        }

    def causes(self, category: TaskCategory | None = None) -> Counter[Cause]:
        """Number of failed plans by cause, in the order of ``Cause``."""
        counted = Counter(
            verdict.cause
            for task in self.of_category(category)
            for verdict in task.known
            if verdict.cause is not None
        )
        return Counter({cause: counted[cause] for cause in Cause if counted[cause]})

    @cached_property
    def reasons(self) -> Mapping[Cause, Counter[str]]:
        """Number of failed plans by reason, for each cause."""
        found: dict[Cause, Counter[str]] = {}
        for task in self.tasks:
            for verdict in task.known:
                if verdict.cause is not None:
                    found.setdefault(verdict.cause, Counter())[verdict.reason or verdict.cause.value] += 1
        return {cause: found[cause] for cause in Cause if cause in found}

    def as_json(self) -> dict[str, Any]:
        """All figures and verdicts. The result does not depend on when or where the plans were executed."""
        return {
            "tasks": len(self.tasks),
            "tasks_failed_by_rule": self.by_rule,
            "samples": self.samples,
            "lost": self.lost,
            "overall": self._figures(None),
            "success_over_all": estimate_to_json(self.success_over_all()),
            "categories": {category.value: self._figures(category) for category in self.categories},
            "reasons": {cause.value: dict(sorted(counts.items())) for cause, counts in self.reasons.items()},
            "verdicts": [_task_to_json(task) for task in self.tasks],
        }

    def _figures(self, category: TaskCategory | None) -> dict[str, Any]:
        return {
            "tasks": len(self.of_category(category)),
            "success": estimate_to_json(self.success(category)),
            "partial": estimate_to_json(self.partial(category)),
            "pass_at": {str(k): estimate_to_json(found) for k, found in self.pass_at(category).items()},
            "causes": {cause.value: count for cause, count in self.causes(category).items()},
        }


def estimate_to_json(estimate: Estimate) -> dict[str, Any]:
    """JSON-serialisable dict of an estimate. Unknown numbers are null."""
    numbers = {
        name: None if math.isnan(value) else value for name, value in asdict(estimate.interval).items()
    }
    return {**numbers, "method": estimate.method.value, "tasks": estimate.tasks}


def _task_to_json(task: TaskResult) -> dict[str, Any]:
    return {
        "task": task.task_id,
        "category": task.category.value,
        "samples": [
            {
                "sample": verdict.sample,
                "success": verdict.success,
                "partial": verdict.partial,
                "steps": verdict.steps,
                "done": verdict.done,
                **({"lost": True} if verdict.lost else {}),
                **(
                    {"cause": verdict.cause.value, "reason": verdict.reason, "step": verdict.step}
                    if verdict.cause is not None
                    else {}
                ),
            }
            for verdict in task.verdicts
        ],
    }
