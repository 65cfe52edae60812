"""Fair sharing of slot time between runs, by start-time fair queueing (Goyal, Vin and Cheng 1996).

A run's turn grows by the slot time of its leases divided by its weight, and the run with the smallest turn goes first. A
run that had nothing waiting starts level with the others, so idle time earns no credit. Level means what the others have
paid: the advance charge of live leases is an estimate and may be many times too high.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from embomatrix.manager.control.dispatch.records import FairShareTurn, LeaseRecord, RolloutRecord, RunCounters
from embomatrix.rpc.wire.values import RunTerms

GUESS_S: Final = 1.0
"""Assumed slot time before the first measurement; equal for all runs, so that they start level."""
LEARNING: Final = 0.1
SAMPLES: Final = 512
SORT_EVERY: Final = 32


class SlotTimes:
    """Slot times of a run's latest leases, in seconds of the manager's clock."""

    def __init__(self, known_after: int) -> None:
        self.mean_s = GUESS_S
        self._known_after = known_after
        self._latest: deque[float] = deque(maxlen=SAMPLES)
        self._ordered: list[float] = []
        self._unsorted = 0

    def add(self, seconds: float) -> None:
        first = not self._latest
        self._latest.append(seconds)
        self.mean_s = seconds if first else self.mean_s + LEARNING * (seconds - self.mean_s)
        self._unsorted += 1

    def quantile_s(self, share: float) -> float | None:
        """Return a quantile that may lag by ``SORT_EVERY`` samples; None below ``known_after`` samples."""
        if len(self._latest) < self._known_after:
            return None
        if self._unsorted >= SORT_EVERY or not self._ordered:
            self._ordered, self._unsorted = sorted(self._latest), 0
        return self._ordered[min(int(share * len(self._ordered)), len(self._ordered) - 1)]


@dataclass(slots=True, eq=False)
class RunAccount:
    """Terms, counters and slot-time account of one run."""

    times: SlotTimes
    terms: RunTerms = field(default_factory=RunTerms)
    counters: RunCounters = field(default_factory=RunCounters)
    submitted: int = 0
    turn_s: float = 0.0
    """Slot time over weight."""
    ahead_s: float = 0.0
    """Part of ``turn_s`` that live leases were charged in advance."""


class RunAccounts:
    """Accounts by run id. A run that was never opened has the default terms."""

    def __init__(self, known_after: int) -> None:
        self._known_after = known_after
        self._runs: dict[str, RunAccount] = {}
        self._paid_s: dict[int, float] = {}
        """Largest paid turn of a run at the time it was given a lease, by priority."""

    def __iter__(self) -> Iterator[str]:
        return iter(self._runs)

    def __contains__(self, run_id: str) -> bool:
        return run_id in self._runs

    def of(self, run_id: str) -> RunAccount:
        run = self._runs.get(run_id)
        if run is None:
            run = self._runs[run_id] = RunAccount(SlotTimes(self._known_after))
        return run

    def forget(self, run_id: str) -> None:
        self._runs.pop(run_id, None)

    def turn(self, record: RolloutRecord) -> FairShareTurn:
        """Sort key: higher priority first, then the run with less slot time, then submission order."""
        run = self.of(record.key.run_id)
        return -run.terms.priority, run.turn_s, record.sequence

    def wake(self, run_id: str) -> None:
        """Level the run with the others: it has waiting rollouts again after it had none."""
        run = self.of(run_id)
        run.turn_s = max(run.turn_s, self._paid_s.get(run.terms.priority, 0.0))

    def charge(self, lease: LeaseRecord) -> None:
        """Charge the run the mean slot time for a new lease; ``settle`` corrects it."""
        run = self.of(lease.record.key.run_id)
        paid_s = self._paid_s.get(run.terms.priority, 0.0)
        self._paid_s[run.terms.priority] = max(paid_s, run.turn_s - run.ahead_s)
        lease.charged_s = run.times.mean_s / run.terms.weight
        run.turn_s += lease.charged_s
        run.ahead_s += lease.charged_s

    def settle(self, lease: LeaseRecord, now_s: float) -> None:
        """Replace the advance charge of an ended lease by the slot time that it took."""
        run = self._runs.get(lease.record.key.run_id)
        if run is not None:
            took_s = 0.0 if lease.started_s is None else now_s - lease.started_s
            run.turn_s += took_s / run.terms.weight - lease.charged_s
            run.ahead_s -= lease.charged_s
