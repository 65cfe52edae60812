"""Report of a simulation: figures that its actors collect, and shares made from them."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from statistics import fmean
from typing import TYPE_CHECKING

from embomatrix.manager.histogram import quantile
from embomatrix.rpc.wire.values import RunStats

if TYPE_CHECKING:
    from embomatrix.manager.simulation.scenario import SimulationScenario


@dataclass(slots=True)
class Report:
    """Figures of one simulation, complete at its end. Times are simulated seconds; CPU times are real."""

    scenario: SimulationScenario
    slots: int
    submitted: int = 0
    delivered: int = 0
    infra_failures: int = 0
    stats: RunStats = field(default_factory=RunStats)
    elapsed_s: float = 0.0
    """Time from the start of the first step to the last result."""
    waits_s: list[float] = field(default_factory=list)
    """Time from the last submission of each step to its last result: the trainer stands still."""
    stall: float = 0.0
    """Share of the time after the first step in which trainers only waited for results."""
    busy: list[int] = field(default_factory=list)
    """Samples of the number of executing slots, after the first steps, while there is work for every slot."""
    shared: Counter[str] = field(default_factory=Counter)
    """Executions of each run, summed over the samples in which every run wanted all slots."""
    foretold: int = 0
    """Groups after the first step of their run, whose scenes could be announced in time."""
    warm: int = 0
    """Those of them with a warm scene on arrival."""
    loads: int = 0
    loads_unused: int = 0
    cpu_s: float = 0.0
    """CPU time of the manager's decisions."""
    died_s: dict[str, float] = field(default_factory=dict)
    """Time of each worker's last death, until the manager detects it."""
    detected_s: list[float] = field(default_factory=list)
    """Time from each death of a worker to its detection."""
    orphaned_s: list[float] = field(default_factory=list)
    """Time from the loss of a worker to the next lease of each rollout that it held."""
    first_queued_s: list[float] = field(default_factory=list)
    """Time from the submission of each group to the start of its first execution, which waits for the scene."""
    first_result_s: float = 0.0
    """Longest time of any run from its first submission to its first result."""
    groups_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """Time from the submission of each group to its last result, by run."""
    lags_s: list[float] = field(default_factory=list)
    """Time that each message waited for the manager to handle earlier ones."""
    counts: Counter[str] = field(default_factory=Counter)
    caught: dict[str, int] = field(default_factory=dict)
    """Executions compared by then, for each worker put in quarantine."""

    @property
    def pressed_utilisation(self) -> float | None:
        """Mean share of slots executing while there was work for every slot; None if never."""
        return sum(self.busy) / (len(self.busy) * self.slots) if self.busy else None

    @property
    def hit_rate(self) -> float:
        """Share of the announced groups with a warm scene on arrival; 1 if there were none."""
        return self.warm / self.foretold if self.foretold else 1.0

    @property
    def waste(self) -> float:
        """Share of the loads that no rollout used."""
        return self.loads_unused / self.loads if self.loads else 0.0

    @property
    def start_latency_s(self) -> float:
        """Mean time from a group's submission to its first execution."""
        return fmean(self.first_queued_s) if self.first_queued_s else 0.0

    @property
    def shares(self) -> dict[str, float]:
        """Share of the busy slots of each run, while every run wanted all of them; empty if that never happened."""
        return {run: count / self.shared.total() for run, count in self.shared.items()}

    @property
    def lag_p99_s(self) -> float:
        """99th percentile of the time that messages waited for the manager; 0 for one that answers at once."""
        return quantile(sorted(self.lags_s), 0.99)

    @property
    def cpu_us_per_rollout(self) -> float:
        """CPU time of all decisions per delivered rollout, in microseconds."""
        return 1e6 * self.cpu_s / self.delivered

    def note_lost(self, worker_id: str, now_s: float) -> None:
        """Note that the manager gave up a worker, or saw it register again."""
        if worker_id in self.died_s:
            self.detected_s.append(now_s - self.died_s.pop(worker_id))

    @contextmanager
    def deciding(self) -> Iterator[None]:
        """Charge the thread's CPU time inside the block to the manager."""
        begin_s = time.thread_time()
        try:
            yield
        finally:
            self.cpu_s += time.thread_time() - begin_s
