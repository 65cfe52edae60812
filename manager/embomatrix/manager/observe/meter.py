"""What people watch: throughput, latencies, outcomes, and the latest failures with their reasons."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.manager.observe.histogram import quantile
from embomatrix.rpc.wire.values import Cancelled, Completed, InfraFailure

if TYPE_CHECKING:
    from embomatrix.rpc.wire.values import RolloutResult

WINDOW_S: Final = 120
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
        self._per_second: deque[tuple[int, int]] = deque(maxlen=WINDOW_S)

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
        """Completed rollouts of each of the last ``WINDOW_S`` whole seconds, oldest first."""
        counts = dict(self._per_second)
        return [counts.get(second, 0) for second in range(int(now_s) - WINDOW_S, int(now_s))]

    def latency_s(self, share: float) -> float:
        """The latency that this share of the latest rollouts did not exceed; 0 before the first."""
        return quantile(sorted(self._latency_s), share)

    def _count(self, second: int) -> None:
        if self._per_second and self._per_second[-1][0] == second:
            self._per_second[-1] = (second, self._per_second[-1][1] + 1)
        else:
            self._per_second.append((second, 1))
