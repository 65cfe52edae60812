"""What people watch: throughput, latencies, outcomes, and the latest failures with their reasons."""

from __future__ import annotations

import bisect
import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.values import Cancelled, Completed, InfraFailure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.rpc.values import RolloutResult

WINDOW_S: Final = 120
"""Length of the throughput's history."""
SAMPLES: Final = 2048
FAILURES_KEPT: Final = 50
BUCKETS_S: Final = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)


@dataclass(frozen=True, slots=True)
class FailureNote:
    """A failure of the infrastructure, as the dashboard shows it. ``at_s`` is seconds since the epoch."""

    at_s: float
    code: str
    message: str
    worker_id: str
    run_id: str
    rollout_id: str


class Histogram:
    """Cumulative counts by upper bound, as Prometheus wants them."""

    def __init__(self) -> None:
        self.counts = [0] * (len(BUCKETS_S) + 1)
        self.sum_s = 0.0

    def observe(self, seconds: float) -> None:
        self.counts[bisect.bisect_left(BUCKETS_S, seconds)] += 1
        self.sum_s += seconds


class Meter:
    """Takes every delivered result. The clock of its history is the caller's monotonic one."""

    def __init__(self) -> None:
        self.outcomes: Counter[str] = Counter()
        self.phases: dict[str, Histogram] = {name: Histogram() for name in ("queue", "load", "execute")}
        self.failures: deque[FailureNote] = deque(maxlen=FAILURES_KEPT)
        self._latency_s: deque[float] = deque(maxlen=SAMPLES)
        self._per_second: deque[tuple[int, int]] = deque(maxlen=WINDOW_S)

    def observe(self, run_id: str, result: RolloutResult, now_s: float) -> None:
        match result.outcome:
            case Completed(timings=timings):
                self.outcomes["completed"] += 1
                self.phases["queue"].observe(timings.queued_s)
                self.phases["load"].observe(timings.load_s)
                self.phases["execute"].observe(timings.execute_s)
                self._latency_s.append(timings.queued_s + timings.load_s + timings.execute_s)
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


def quantile(ordered: Sequence[float], share: float) -> float:
    """The value at that share of an ascending sequence; 0 for an empty one."""
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else 0.0
