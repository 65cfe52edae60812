"""The numbers of an evaluation: success and partial credit, overall and by category, pass@k, and why plans failed."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

from embomatrix.trainer.evaluation.intervals import Estimate, mean_over_tasks, pass_at
from embomatrix.trainer.evaluation.taxonomy import Cause
from embomatrix.world.task import TaskCategory

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from embomatrix.trainer.evaluation.verdicts import AnswerVerdict

KS: Final = (1, 2, 3, 5, 10, 20, 50, 100)
"""The k of pass@k, as far as there are samples."""


@dataclass(frozen=True)
class TaskResult:
    """One task's verdicts, in the order of the samples. Figures are over those that the infrastructure did not lose."""

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
        """Share of the samples that succeed; NaN where nothing is known."""
        return self.successes / len(self.known) if self.known else math.nan

    @property
    def partial(self) -> float:
        """Mean share of the goal's atoms that hold at the end; NaN where nothing is known."""
        return sum(verdict.partial for verdict in self.known) / len(self.known) if self.known else math.nan


@dataclass(frozen=True)
class Scoreboard:
    """Results of all tasks, in the order of the benchmark. ``by_rule`` tasks can't be expressed: no answer was asked for."""

    tasks: tuple[TaskResult, ...]
    by_rule: int = 0

    @staticmethod
    def of(
        tasks: Mapping[str, TaskCategory], verdicts: Sequence[AnswerVerdict], by_rule: int = 0
    ) -> Scoreboard:
        """Verdicts in any order, sorted to their tasks; ``tasks`` are the ids and categories of all that were asked."""
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
        """Those that come up, in the order of the paper's table."""
        present = {task.category for task in self.tasks}
        return tuple(category for category in TaskCategory if category in present)

    @cached_property
    def samples(self) -> int:
        return sum(len(task.verdicts) for task in self.tasks)

    @cached_property
    def lost(self) -> int:
        return sum(len(task.verdicts) - len(task.known) for task in self.tasks)

    def of_category(self, category: TaskCategory | None) -> tuple[TaskResult, ...]:
        """Tasks of a category, or all for None."""
        return tuple(task for task in self.tasks if category in (None, task.category))

    def success(self, category: TaskCategory | None = None) -> Estimate:
        """Mean over the tasks of the share of samples that succeed."""
        return mean_over_tasks([task.rate for task in self.of_category(category)])

    def success_over_all(self) -> Estimate:
        """The same, where tasks that can't be expressed count as failed."""
        return mean_over_tasks([*(task.rate for task in self.tasks), *([0.0] * self.by_rule)])

    def partial(self, category: TaskCategory | None = None) -> Estimate:
        """Mean over the tasks of the share of the goal's atoms that hold at the end."""
        return mean_over_tasks([task.partial for task in self.of_category(category)])

    def pass_at(self, category: TaskCategory | None = None) -> dict[int, Estimate]:
        """k to the mean over the tasks of the chance that one of k samples succeeds."""
        tasks = self.of_category(category)
        most = max((len(task.known) for task in tasks), default=0)
        return {
            k: mean_over_tasks([pass_at(k, len(task.known), task.successes) for task in tasks])
            for k in KS
            if k <= most
        }

    def causes(self, category: TaskCategory | None = None) -> Counter[Cause]:
        """How many plans failed for each cause, in the order of the causes."""
        counted = Counter(
            verdict.cause
            for task in self.of_category(category)
            for verdict in task.known
            if verdict.cause is not None
        )
        return Counter({cause: counted[cause] for cause in Cause if counted[cause]})

    @cached_property
    def reasons(self) -> Mapping[Cause, Counter[str]]:
        """Under each cause how many plans failed for each reason of a step or a text."""
        found: dict[Cause, Counter[str]] = {}
        for task in self.tasks:
            for verdict in task.known:
                if verdict.cause is not None:
                    found.setdefault(verdict.cause, Counter())[verdict.reason or verdict.cause.value] += 1
        return {cause: found[cause] for cause in Cause if cause in found}

    def as_json(self) -> dict[str, Any]:
        """All figures, and every verdict. Nothing in it depends on when or where the plans were executed."""
        return {
            "tasks": len(self.tasks),
            "tasks_failed_by_rule": self.by_rule,
            "samples": self.samples,
            "lost": self.lost,
            "overall": self._figures(None),
            "success_over_all": estimate_to_json(self.success_over_all()),
            "categories": {category.value: self._figures(category) for category in self.categories},
            "reasons": {cause.value: dict(sorted(counts.items())) for cause, counts in self.reasons.items()},
            "verdicts": [_verdicts_to_json(task) for task in self.tasks],
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
    """Numbers as they are, null where nothing is known."""
    interval = estimate.interval
    plain: Callable[[float], float | None] = lambda value: None if math.isnan(value) else value  # noqa: E731
    return {
        "value": plain(interval.value),
        "low": plain(interval.low),
        "high": plain(interval.high),
        "method": estimate.method.value,
        "tasks": estimate.tasks,
    }


def _verdicts_to_json(task: TaskResult) -> dict[str, Any]:
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
