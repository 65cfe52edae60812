"""Measurements of a simulation and the report made from them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.rpc.wire.values import RunStats

if TYPE_CHECKING:
    from embomatrix.manager.simulation.scenario import SimulationScenario


class Measurements:
    """Counters of one simulation, read at its end."""

    def __init__(self) -> None:
        self.cpu_s = 0.0
        """CPU time of the manager's decisions."""
        self.waits_s: list[float] = []
        """Time from the last submission of each step to its last result: the trainer stands still."""
        self.first_queued_s: list[float] = []
        """Time from the submission of each group to the start of its first execution, which waits for the scene."""
        self.foretold = self.warm = 0
        """Groups after a run's first step, whose scenes could be announced in time, and those with a warm scene."""
        self.loads = 0
        self.loads_unused = 0
        self.pressed: list[tuple[int, int]] = []
        """Samples of (executing, existing) slots while there is work for every slot."""
        self.shared: Counter[str] = Counter()
        """Executions of each run, summed over the samples in which every run wanted all slots."""
        self.died_s: dict[str, float] = {}
        """Time of each worker's last death, until the manager detects it."""
        self.detected_s: list[float] = []
        """Time from each death of a worker to its detection."""
        self.counts: Counter[str] = Counter()
        self.lags_s: list[float] = []
        """Time that each message waited for the manager to handle earlier ones."""
        self.caught: dict[str, int] = {}
        """Executions compared by then, for each worker put in quarantine."""

    def lost(self, worker_id: str, now_s: float) -> None:
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


@dataclass(frozen=True, slots=True)
class Report:
    """Results of a simulation. Times are simulated seconds; CPU times are real."""

    scenario: SimulationScenario
    slots: int
    submitted: int
    delivered: int
    infra_failures: int
    stats: RunStats
    elapsed_s: float
    """Time from the start of the first step to the last result."""
    waits_s: tuple[float, ...]
    pressed_utilisation: float | None
    """Share of slots executing, after the first steps, while at least as many rollouts as slots were open; None if never."""
    stall: float
    """Share of the time after the first step in which trainers only waited for results."""
    foretold: int
    """Groups after the first step of their run, whose scenes could be announced in time."""
    hit_rate: float
    """Share of these with a warm scene on arrival; 1 if there were none."""
    loads: int
    loads_unused: int
    cpu_s: float
    detected_s: tuple[float, ...]
    """Time from each death of a worker to its detection."""
    orphaned_s: tuple[float, ...]
    """Time from the loss of a worker to the next lease of each rollout that it held."""
    start_latency_s: float
    """Mean time from a group's submission to its first execution."""
    first_result_s: float
    """Longest time of any run from its first submission to its first result."""
    groups_s: Mapping[str, tuple[float, ...]]
    """Time from the submission of each group to its last result, by run."""
    shares: Mapping[str, float]
    """Share of the busy slots of each run, while every run wanted all of them; empty if that never happened."""
    lag_p99_s: float
    """99th percentile of the time that messages waited for the manager; 0 for one that answers at once."""
    counts: Mapping[str, int]
    caught: Mapping[str, int]
    """Executions compared by then, for each worker put in quarantine."""

    @property
    def waste(self) -> float:
        """Share of the loads that no rollout used."""
        return self.loads_unused / self.loads if self.loads else 0.0

    @property
    def cpu_us_per_rollout(self) -> float:
        """CPU time of all decisions per delivered rollout, in microseconds."""
        return 1e6 * self.cpu_s / self.delivered
