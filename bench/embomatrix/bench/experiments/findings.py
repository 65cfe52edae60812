"""Findings of an experiment: success of each arm over all seeds, learning curves, and time shares."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from embomatrix.bench.experiments.design import WITHOUT_RELEVANCE, Design
from embomatrix.pages.figures import Better, Figure, Interval
from embomatrix.trainer.evaluation.intervals import (
    bootstrap,
    differences,
    mean_difference,
    over_seeds_and_tasks,
)
from embomatrix.trainer.logging.outcome import OUTCOME, RunOutcome, TaskRate, read_outcome
from embomatrix.trainer.logging.recorder import read_metrics

BINS: Final = 10
"""Number of equal parts of a run; a curve has one mean per part."""
MOST_WAIT: Final = 0.05
MOST_OVERHEAD: Final = 0.10
SUCCESS_AFTER: Final = 0.70
LEAST_GAIN: Final = 0.15


@dataclass(frozen=True, slots=True)
class Run:
    """Finished run: its outcome and one metrics record for each step."""

    seed: int
    arm: str
    outcome: RunOutcome
    metrics: Sequence[Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class ArmFindings:
    """One arm over all seeds. Success is on held-out tasks; ``gain`` is the paired difference after − before."""

    name: str
    runs: tuple[Run, ...]
    before: Interval
    after: Interval
    gain: Interval

    @property
    def wait_share(self) -> float:
        return _mean([run.outcome.shares.waiting for run in self.runs])

    @property
    def overhead(self) -> float:
        return _mean([run.outcome.shares.overhead for run in self.runs])


def read_runs(design: Design, folder_of: Callable[[int, str], Path]) -> dict[str, list[Run]]:
    """Read the finished runs by arm. Raise TrainerError for a damaged one."""
    runs: dict[str, list[Run]] = {arm.name: [] for arm in design.arms}
    for name, found in runs.items():
        for seed in design.seeds:
            folder = folder_of(seed, name)
            if (folder / OUTCOME).is_file():
                found.append(Run(seed, name, read_outcome(folder), read_metrics(folder)))
    return runs


def findings_of(name: str, runs: Sequence[Run]) -> ArmFindings:
    """Summarise an arm's runs. Tasks are the sampling unit: each counts once, with its mean over the seeds."""
    before = [by_task(run.outcome.before) for run in runs]
    after = [by_task(run.outcome.after) for run in runs]
    gains = [differences(then, now) for then, now in zip(before, after, strict=True)]
    return ArmFindings(
        name,
        tuple(runs),
        bootstrap(_over_seeds(before)),
        bootstrap(_over_seeds(after)),
        _interval(gains),
    )


def difference(first: ArmFindings, other: ArmFindings) -> Interval:
    """Success of another arm after GRPO minus that of the first one, paired by seed and task."""
    known = {run.seed: by_task(run.outcome.after) for run in first.runs}
    return _interval(
        [
            differences(known[run.seed], now)
            for run in other.runs
            if run.seed in known and (now := by_task(run.outcome.after))
        ]
    )


def _interval(found: Sequence[Mapping[str, float]]) -> Interval:
    """Mean of differences by seed and task, with an interval over both; over tasks alone if there is one seed."""
    if len(found) > 1:
        return over_seeds_and_tasks(found)
    return mean_difference(_over_seeds(found))


def by_task(rates: Sequence[TaskRate]) -> dict[str, float]:
    """Success by task, without tasks of unknown success."""
    return {each.task_id: each.rate for each in rates if each.rate is not None}


def _over_seeds(rates: Sequence[Mapping[str, float]]) -> list[float]:
    found: dict[str, list[float]] = {}
    for each in rates:
        for task, rate in each.items():
            found.setdefault(task, []).append(rate)
    return [_mean(values) for _, values in sorted(found.items())]


def curve(run: Run, key: str) -> tuple[float, ...]:
    """Means of a metric over ``BINS`` equal parts of a run, fewer if the run has fewer steps; NaN if no step has the metric."""
    values = np.array([math.nan if row[key] is None else float(row[key]) for row in run.metrics])
    parts = np.array_split(values, max(1, min(BINS, len(values))))
    return tuple(_mean(list(part[~np.isnan(part)])) for part in parts if part.size)


def figures_of(arms: Sequence[ArmFindings]) -> tuple[Figure, ...]:
    """Figures of an experiment; those of the first arm have the plain names, and the others are compared with it."""
    first = arms[0]
    tasks = len(_over_seeds([by_task(run.outcome.after) for run in first.runs]))
    count = tasks * len(first.runs)
    found = [
        Figure("success_before", first.before.value, "", Better.HIGHER, count),
        Figure("success_after", first.after.value, "", Better.HIGHER, count, SUCCESS_AFTER),
        Figure("success_gain", first.gain.value, "", Better.HIGHER, count, LEAST_GAIN),
        Figure("success_gain_low", first.gain.low, "", Better.HIGHER, count, 0.0),
    ]
    for arm in arms[1:]:
        known = {WITHOUT_RELEVANCE: "success_after_no_relevance"}
        name = known.get(arm.name, f"success_after_{arm.name}")
        found.append(Figure(name, arm.after.value, "", Better.NEITHER, tasks * len(arm.runs)))
        change = difference(first, arm)
        for end, value in (("", change.value), ("_low", change.low), ("_high", change.high)):
            found.append(Figure(f"success_difference_{arm.name}{end}", value, "", Better.NEITHER, tasks))
    steps = sum(run.outcome.steps for run in first.runs)
    found += [
        Figure("sim_wait_share", first.wait_share, "", Better.LOWER, steps, MOST_WAIT),
        Figure("overhead_ratio", first.overhead, "", Better.LOWER, steps, MOST_OVERHEAD),
    ]
    return tuple(figure for figure in found if not math.isnan(figure.value))


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan
