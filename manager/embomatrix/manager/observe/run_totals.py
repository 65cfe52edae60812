"""Totals of a run as a list of named numbers, the same for every run, so that two runs can be compared."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from embomatrix.manager.observe.training_reports import TrainingDetail
from embomatrix.rpc.wire.run_log import PhaseSummary, RolloutPhase, RunSummary

ENDS: Final = 10
"""Latest steps of a curve whose mean is a total."""


class TotalUnit(StrEnum):
    """Unit of a total. Shares are between 0 and 1, rates per second."""

    COUNT = "count"
    SHARE = "share"
    SECONDS = "seconds"
    RATE = "rate"
    NUMBER = "number"


class Aim(StrEnum):
    """Direction in which a total improves; ``NONE`` where a difference is neither good nor bad."""

    UP = "up"
    DOWN = "down"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class RunTotal:
    """One total. ``value`` is None if the run has no such number, such as a success without a trainer."""

    name: str
    value: float | None
    unit: TotalUnit
    aim: Aim = Aim.NONE


def run_totals(summary: RunSummary, training: TrainingDetail | None = None) -> list[RunTotal]:
    """Return the totals in a fixed order. Those of training are left out if the trainer did not report."""
    return [*_work(summary), *_times(summary), *_costs(summary), *_learned(training)]


def length_s(summary: RunSummary) -> float:
    """Return the length of a closed run; of an open run, up to its last outcome."""
    if summary.run.closed_s:
        return summary.run.closed_s - summary.run.opened_s
    return len(summary.series.completed) * summary.series.step_s


def working_s(summary: RunSummary) -> float:
    """Return the seconds of the intervals in which rollouts were completed."""
    return summary.series.step_s * sum(count > 0 for count in summary.series.completed)


def _work(summary: RunSummary) -> Iterator[RunTotal]:
    stats, completed = summary.run.stats, sum(summary.series.completed)
    busy_s = working_s(summary)
    rate = completed / busy_s if busy_s else None
    yield RunTotal("length", length_s(summary), TotalUnit.SECONDS)
    yield RunTotal("completed rollouts", completed, TotalUnit.COUNT)
    yield RunTotal("infrastructure failures", stats.infra_failures, TotalUnit.COUNT, Aim.DOWN)
    yield RunTotal("re-dispatches", stats.redispatched, TotalUnit.COUNT, Aim.DOWN)
    yield RunTotal("throughput while there was work", rate, TotalUnit.RATE, Aim.UP)
    yield RunTotal("workers", sum(worker.completed > 0 for worker in summary.workers), TotalUnit.COUNT)


def _times(summary: RunSummary) -> Iterator[RunTotal]:
    for phase, words in ((RolloutPhase.QUEUE, "queue"), (RolloutPhase.EXECUTE, "execute")):
        found = summary.phases.get(phase, PhaseSummary())
        for share, value in (("median", found.p50_s), ("99 %", found.p99_s)):
            yield RunTotal(f"{words}, {share}", value if found.count else None, TotalUnit.SECONDS, Aim.DOWN)


def _costs(summary: RunSummary) -> Iterator[RunTotal]:
    stats = summary.run.stats
    hits = _share(stats.prewarm_hits, stats.prewarm_hits + stats.prewarm_misses)
    yield RunTotal("prewarm hits", hits, TotalUnit.SHARE, Aim.UP)
    yield RunTotal("shared steps", _share(stats.shared_steps, stats.steps), TotalUnit.SHARE)
    yield RunTotal("manager overhead", summary.overhead, TotalUnit.SHARE, Aim.DOWN)


def _learned(training: TrainingDetail | None) -> Iterator[RunTotal]:
    phases = {curves.phase: curves for curves in training.phases} if training is not None else {}
    grpo = phases.get("grpo")
    if grpo is not None:
        yield RunTotal("GRPO steps", grpo.last_step, TotalUnit.COUNT)
        yield RunTotal("reward, latest steps", grpo.latest("reward", ENDS), TotalUnit.NUMBER, Aim.UP)
        yield RunTotal("success, latest steps", grpo.latest("success", ENDS), TotalUnit.SHARE, Aim.UP)
    for when in ("before", "after"):
        tested = phases.get(f"success {when} GRPO")
        if tested is not None:
            yield RunTotal(f"held-out success {when} GRPO", tested.latest("all", 1), TotalUnit.SHARE, Aim.UP)


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None
