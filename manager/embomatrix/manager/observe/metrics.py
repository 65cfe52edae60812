"""Load of the manager (CPU accounting, clock lag, store latency), counters of delivered results, and of errors."""

import logging
import time
from collections import Counter, defaultdict, deque
from dataclasses import dataclass
from typing import Final, NamedTuple

from embomatrix.manager.histogram import Histogram, quantile
from embomatrix.rpc.wire.run_log import LEAST_WORK_S
from embomatrix.rpc.wire.values import Cancelled, Completed, InfraFailure, RolloutResult

WINDOW_S: Final = 60.0


class _Sample(NamedTuple):
    """CPU time of the manager and of the slots so far, in seconds, at a time of the monotonic clock."""

    at_s: float
    manager_s: float
    slots_s: float


class ManagerLoad:
    """CPU accounting, clock lag and store latency of the manager."""

    def __init__(self) -> None:
        self.lag = Histogram()
        """Lag of each tick in seconds. More than a few hundredths mean that the event loop is saturated."""
        self.longest_lag_s = 0.0
        self.store: defaultdict[str, Histogram] = defaultdict(Histogram)
        """Durations of store operations in seconds, by name."""
        self._samples: deque[_Sample] = deque()

    def lagged(self, seconds: float) -> None:
        """Count the lag of a tick."""
        self.lag.observe(seconds)
        self.longest_lag_s = max(self.longest_lag_s, seconds)

    def operated(self, operation: str, seconds: float) -> None:
        """Count an operation of the store."""
        self.store[operation].observe(seconds)

    def sample(self, now_s: float, manager_s: float, slots_s: float) -> None:
        """Note the CPU time so far. A slot runs on one core, so its busy time counts as CPU time."""
        self._samples.append(_Sample(now_s, manager_s, slots_s))
        while len(self._samples) > 2 and self._samples[1].at_s <= now_s - WINDOW_S:
            self._samples.popleft()

    def overhead(self) -> float:
        """Return the manager's share of the CPU time of manager and slots in the last minute; 0 if hardly anything ran."""
        _, manager_s, slots_s = self._spent()
        return manager_s / (manager_s + slots_s) if slots_s >= LEAST_WORK_S else 0.0

    def core_share(self) -> float:
        """Return the share of one core that the manager used in the last minute."""
        seconds, manager_s, _ = self._spent()
        return manager_s / seconds if seconds > 0 else 0.0

    def slots_at_work(self) -> float:
        """Return the mean number of slots that executed plans in the last minute."""
        seconds, _, slots_s = self._spent()
        return slots_s / seconds if seconds > 0 else 0.0

    def _spent(self) -> _Sample:
        """Return the length of the window, and the CPU time in it."""
        if len(self._samples) < 2:
            return _Sample(0.0, 0.0, 0.0)
        first, last = self._samples[0], self._samples[-1]
        return _Sample(*(after - before for before, after in zip(first, last, strict=True)))


class ErrorCount(logging.Handler):
    """Number of errors that the manager logged while the context is held. Each INTERNAL answer is one."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.total = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.total += 1

    def __enter__(self) -> None:
        logging.getLogger("embomatrix").addHandler(self)

    def __exit__(self, *_: object) -> None:
        logging.getLogger("embomatrix").removeHandler(self)


THROUGHPUT_S: Final = 120
"""Seconds of throughput history."""
SAMPLES: Final = 2048
FAILURES_KEPT: Final = 50
WORKERS_KEPT: Final = 20_000
"""Workers whose results are counted at most; the first seen are dropped."""


@dataclass(frozen=True, slots=True)
class FailureNote:
    """Infrastructure failure for the dashboard. ``at_s`` is seconds since the epoch; ``count`` equal rollouts share it."""

    at_s: float
    code: str
    message: str
    worker_id: str
    run_id: str
    rollout_id: str
    count: int = 1


class Meter:
    """Counters of delivered results. Times are on the caller's monotonic clock.

    A result counts once for each of its equal rollouts; latencies are of executions.
    """

    def __init__(self) -> None:
        self.outcomes: Counter[str] = Counter()
        self.failed = 0
        """Rollouts that ended in an infrastructure failure."""
        self.completed_by: Counter[str] = Counter()
        """Completed rollouts by worker, connected or not."""
        self.failures: deque[FailureNote] = deque(maxlen=FAILURES_KEPT)
        self._latency_s: deque[float] = deque(maxlen=SAMPLES)
        self._per_second: Counter[int] = Counter()
        """Completed rollouts of each of the last seconds that had any."""

    def observe(self, run_id: str, result: RolloutResult, now_s: float) -> None:
        match result.outcome:
            case Completed(timings=timings, worker_id=worker_id):
                self.outcomes["completed"] += result.count
                self.completed_by[worker_id] += result.count
                if len(self.completed_by) > WORKERS_KEPT:
                    del self.completed_by[next(iter(self.completed_by))]
                lease_s = timings.lease_s + timings.load_s + timings.execute_s
                self._latency_s.append(timings.queued_s + lease_s)
                self._per_second[int(now_s)] += result.count
                if len(self._per_second) > THROUGHPUT_S:
                    del self._per_second[next(iter(self._per_second))]
            case InfraFailure(code, message, worker_id):
                self.outcomes[code.value] += result.count
                self.failed += result.count
                note = FailureNote(
                    time.time(), code.value, message, worker_id, run_id, result.rollout_id, result.count
                )
                self.failures.appendleft(note)
            case Cancelled():
                self.outcomes["cancelled"] += result.count

    def throughput(self, now_s: float) -> list[int]:
        """Return the completed rollouts of each of the last ``THROUGHPUT_S`` whole seconds, oldest first."""
        return [self._per_second[second] for second in range(int(now_s) - THROUGHPUT_S, int(now_s))]

    def latency_s(self, share: float) -> float:
        """Return the latency in seconds that this share of recent rollouts does not exceed; 0 before the first."""
        return quantile(sorted(self._latency_s), share)
