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
        self.loads = 0
        self.loads_unused = 0
        self.load_s = 0.0
        self.pressed: list[tuple[int, int]] = []
        """Executing and existing slots, while there is work for every slot."""
        self.counts: Counter[str] = Counter()

    @property
    def cpu_s(self) -> float:
        return sum(cost.total_s for cost in self.costs.values())

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
