"""Figures of an open run in bounded memory: durations by phase, work by worker, outcomes over time, latest failures."""

from collections import deque
from dataclasses import astuple, dataclass
from typing import Final

from embomatrix.manager.histogram import Histogram
from embomatrix.rpc.wire.run_log import PhaseSummary, RolloutPhase, RunEvent, RunSeries, RunWorker
from embomatrix.rpc.wire.values import Timings

FAILURES_KEPT: Final = 200
WORKERS_KEPT: Final = 4096
OTHERS: Final = "(others)"
"""Common name of all workers beyond ``WORKERS_KEPT``."""
STEPS: Final = 600
FIRST_STEP_S: Final = 0.25


@dataclass(slots=True)
class WorkerFigures:
    """Work of one worker for the run."""

    completed: int = 0
    failed: int = 0
    execute_s: float = 0.0
    load_s: float = 0.0


class Series:
    """Outcomes over time. When it is full, adjacent steps are merged and the step length doubles."""

    __slots__ = ("_completed", "_failed", "_first_s", "_step_s")

    def __init__(self, first_s: float) -> None:
        self._first_s = first_s
        self._step_s = FIRST_STEP_S
        self._completed: list[int] = []
        self._failed: list[int] = []

    def count(self, now_s: float, *, completed: int = 0, failed: int = 0) -> None:
        """Count outcomes at this time."""
        step = int((now_s - self._first_s) / self._step_s)
        while step >= STEPS:
            self._step_s *= 2
            self._completed, self._failed = _paired(self._completed), _paired(self._failed)
            step //= 2
        if step >= len(self._completed):
            more = [0] * (step + 1 - len(self._completed))
            self._completed += more
            self._failed += more
        self._completed[step] += completed
        self._failed[step] += failed

    def values(self) -> RunSeries:
        return RunSeries(self._step_s, tuple(self._completed), tuple(self._failed))


class RunFigures:
    """Figures of one run. ``opened_s`` and every ``now_s`` are on one monotonic clock."""

    __slots__ = ("failures", "phases", "series", "workers")

    def __init__(self, opened_s: float) -> None:
        self.phases: dict[RolloutPhase, Histogram] = {phase: Histogram() for phase in RolloutPhase}
        self.series = Series(opened_s)
        self.workers: dict[str, WorkerFigures] = {}
        self.failures: deque[RunEvent] = deque(maxlen=FAILURES_KEPT)

    def completed(self, timings: Timings, now_s: float, count: int) -> None:
        """Count the result of ``count`` equal rollouts; its delivery is timed later."""
        phases = self.phases
        phases[RolloutPhase.QUEUE].observe(timings.queued_s)
        phases[RolloutPhase.LEASE].observe(timings.lease_s)
        phases[RolloutPhase.LOAD].observe(timings.load_s)
        phases[RolloutPhase.EXECUTE].observe(timings.execute_s)
        self.series.count(now_s, completed=count)

    def worker(self, worker_id: str) -> WorkerFigures:
        """Return the mutable figures of a worker."""
        found = self.workers.get(worker_id)
        if found is None:
            name = worker_id if len(self.workers) < WORKERS_KEPT else OTHERS
            found = self.workers.setdefault(name, WorkerFigures())
        return found

    def worker_rows(self) -> tuple[RunWorker, ...]:
        """Return the work of each worker, sorted by name."""
        return tuple(RunWorker(name, *astuple(found)) for name, found in sorted(self.workers.items()))


def summary_of(histogram: Histogram) -> PhaseSummary:
    return PhaseSummary(
        histogram.count,
        histogram.sum_s,
        histogram.quantile(0.5),
        histogram.quantile(0.95),
        histogram.quantile(0.99),
    )


def _paired(counts: list[int]) -> list[int]:
    return [sum(counts[at : at + 2]) for at in range(0, len(counts), 2)]
