"""What a simulation measures: the manager's CPU time by what it hears, and the slots' and trainers' simulated time."""

from __future__ import annotations

import time
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


@dataclass(slots=True)
class Cost:
    """Of one kind of message: how many there were and what deciding on them took, seconds of CPU."""

    count: int = 0
    total_s: float = 0.0
    longest_s: float = 0.0

    @property
    def mean_s(self) -> float:
        return self.total_s / self.count


class Gauge:
    """Counters of one simulation, for reading when it is over."""

    def __init__(self) -> None:
        self.costs: dict[str, Cost] = {}
        self.busy_s = 0.0
        """Slot-seconds of executions, also of those whose result was not used."""
        self.waits_s: list[float] = []
        """From the last submission of each step to its last result: the time that a trainer stands still."""
        self.queued_s: list[float] = []
        """From the submission of each completed rollout to the start of its execution."""
        self.first_queued_s: list[float] = []
        """The same of the first rollout of each group: what its scene was waited for."""
        self.foretold = self.warm = 0
        """Groups of steps after the first, which could be announced in time, and those whose scene was warm when they came."""
        self.loads = 0
        self.loads_unused = 0
        self.load_s = 0.0
        self.pressed: list[tuple[int, int]] = []
        """Executing and existing slots, while there is work for every slot."""
        self.shared: Counter[str] = Counter()
        """Executions of each run, summed over the moments at which every run wanted all slots."""
        self.died_s: dict[str, float] = {}
        """When each worker died last, until the manager knows."""
        self.detected_s: list[float] = []
        """From each death of a worker to the manager's knowing of it."""
        self.counts: Counter[str] = Counter()
        self.lags_s: list[float] = []
        """How long each message waited until the manager had dealt with all before it; of a manager that takes time."""
        self.caught: dict[str, int] = {}
        """Workers in quarantine, and how many executions of each had been compared by then."""

    @property
    def cpu_s(self) -> float:
        return sum(cost.total_s for cost in self.costs.values())

    def lost(self, worker_id: str, now_s: float) -> None:
        """The manager gave the worker up, or heard of its next life."""
        if worker_id in self.died_s:
            self.detected_s.append(now_s - self.died_s.pop(worker_id))

    @contextmanager
    def deciding(self, kind: str) -> Iterator[None]:
        """Charge what runs inside to this kind of message. CPU time of the thread: others on the machine don't count."""
        cost = self.costs.setdefault(kind, Cost())
        begin_s = time.thread_time()
        try:
            yield
        finally:
            spent_s = time.thread_time() - begin_s
            cost.count += 1
            cost.total_s += spent_s
            cost.longest_s = max(cost.longest_s, spent_s)
