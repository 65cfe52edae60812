"""What serving costs the manager itself: its share of the CPU time, how late its clock ticks, how long its store takes."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from embomatrix.manager.histogram import Histogram, quantile
from embomatrix.rpc.wire.values import Cancelled, Completed, InfraFailure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.rpc.wire.values import RolloutResult

WINDOW_S: Final = 60.0
OPERATIONS: Final = 64
"""Kinds of operations that a store may have; more would be a defect."""


class _Sample(NamedTuple):
    """At a time of the monotonic clock: CPU time of the manager and of the slots so far, in seconds."""

    at_s: float
    manager_s: float
    slots_s: float


class ManagerLoad:
    """Told by the runtime, every few seconds and with every operation."""

    def __init__(self) -> None:
        self.lag = Histogram()
        """Seconds by which a tick came late: more than a few hundredths mean that the event loop is full."""
        self._store: dict[str, Histogram] = {}
        self._samples: deque[_Sample] = deque()

    @property
    def store(self) -> Mapping[str, Histogram]:
        """Seconds that the store's operations took, by name."""
        return self._store

    def operated(self, operation: str, seconds: float) -> None:
        """An operation of the store took so long."""
        if operation in self._store or len(self._store) < OPERATIONS:
            self._store.setdefault(operation, Histogram()).observe(seconds)

    def sample(self, now_s: float, manager_s: float, slots_s: float) -> None:
        """CPU time so far. A slot executes on one core, so its time in a rollout is its CPU time."""
        self._samples.append(_Sample(now_s, manager_s, slots_s))
        while len(self._samples) > 2 and self._samples[1].at_s <= now_s - WINDOW_S:
            self._samples.popleft()

    def overhead(self) -> float:
        """The manager's part of the CPU time that it and the slots used in the last minute; 0 when nothing ran."""
        if len(self._samples) < 2:
            return 0.0
        first, last = self._samples[0], self._samples[-1]
        manager_s, slots_s = last.manager_s - first.manager_s, last.slots_s - first.slots_s
        return manager_s / (manager_s + slots_s) if slots_s > 0 else 0.0


THROUGHPUT_S: Final = 120
"""Length of the throughput's history."""
SAMPLES: Final = 2048
FAILURES_KEPT: Final = 50
WORKERS_KEPT: Final = 20_000
"""Names of workers whose results are counted; those that were seen first make room."""


@dataclass(frozen=True, slots=True)
class FailureNote:
    """A failure of the infrastructure, as the dashboard shows it. ``at_s`` is seconds since the epoch."""

    at_s: float
    code: str
    message: str
    worker_id: str
    run_id: str
    rollout_id: str


class Meter:
    """Takes every delivered result. The clock of its history is the caller's monotonic one."""

    def __init__(self) -> None:
        self.outcomes: Counter[str] = Counter()
        self.completed_by: Counter[str] = Counter()
        """By worker, whether it is still there or not."""
        self.failures: deque[FailureNote] = deque(maxlen=FAILURES_KEPT)
        self._latency_s: deque[float] = deque(maxlen=SAMPLES)
        self._per_second: deque[tuple[int, int]] = deque(maxlen=THROUGHPUT_S)

    def observe(self, run_id: str, result: RolloutResult, now_s: float) -> None:
        match result.outcome:
            case Completed(timings=timings, worker_id=worker_id):
                self.outcomes["completed"] += 1
                self.completed_by[worker_id] += 1
                if len(self.completed_by) > WORKERS_KEPT:
                    del self.completed_by[next(iter(self.completed_by))]
                lease_s = timings.lease_s + timings.load_s + timings.execute_s
                self._latency_s.append(timings.queued_s + lease_s)
                self._count(int(now_s))
            case InfraFailure(code, message, worker_id):
                self.outcomes[code.value] += 1
                note = FailureNote(time.time(), code.value, message, worker_id, run_id, result.rollout_id)
                self.failures.appendleft(note)
            case Cancelled():
                self.outcomes["cancelled"] += 1

    def throughput(self, now_s: float) -> list[int]:
        """Completed rollouts of each of the last ``THROUGHPUT_S`` whole seconds, oldest first."""
        counts = dict(self._per_second)
        return [counts.get(second, 0) for second in range(int(now_s) - THROUGHPUT_S, int(now_s))]

    def latency_s(self, share: float) -> float:
        """The latency that this share of the latest rollouts did not exceed; 0 before the first."""
        return quantile(sorted(self._latency_s), share)

    def _count(self, second: int) -> None:
        if self._per_second and self._per_second[-1][0] == second:
            self._per_second[-1] = (second, self._per_second[-1][1] + 1)
        else:
            self._per_second.append((second, 1))
