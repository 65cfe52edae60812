"""Runs as the Task-Dispatcher sees them: what each asked for, how long its rollouts take, and how much it has had.

Slot time is shared by start-time fair queueing (Goyal, Vin and Cheng 1996): a run's *turn* grows by the slot time that its
leases take, divided by its weight, and whoever is behind goes first. A run that had nothing waiting begins where the others
are, so that it is neither punished nor paid for having been idle. Where they are tells what they have paid for: what leases
that live are charged in advance is a guess, and may be many times too much.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.dispatch.ledger import RunCounters
from embomatrix.rpc.wire.values import RunTerms

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from embomatrix.manager.control.dispatch.ledger import LeaseRecord, RolloutRecord
    from embomatrix.manager.control.dispatch.pending import Turn

GUESS_S: Final = 1.0
"""Slot time of a rollout before one was measured: the same for all runs, so that they begin as equals."""
LEARNING: Final = 0.1
SAMPLES: Final = 512
SORT_EVERY: Final = 32


class SlotTimes:
    """How long the latest leases of a run held a slot, in seconds on the manager's clock."""

    def __init__(self, known_after: int) -> None:
        self.mean_s = GUESS_S
        self._known_after = known_after
        self._latest: deque[float] = deque(maxlen=SAMPLES)
        self._ordered: list[float] = []
        self._news = 0

    def add(self, seconds: float) -> None:
        first = not self._latest
        self._latest.append(seconds)
        self.mean_s = seconds if first else self.mean_s + LEARNING * (seconds - self.mean_s)
        self._news += 1

    def quantile_s(self, share: float) -> float | None:
        """Of the latest executions, a few of the very last perhaps left out; None before there are enough."""
        if len(self._latest) < self._known_after:
            return None
        if self._news >= SORT_EVERY or not self._ordered:
            self._ordered, self._news = sorted(self._latest), 0
        return self._ordered[min(int(share * len(self._ordered)), len(self._ordered) - 1)]


@dataclass(slots=True, eq=False)
class RunAccount:
    """One run. ``turn_s`` is slot time over weight."""

    times: SlotTimes
    terms: RunTerms = field(default_factory=RunTerms)
    counters: RunCounters = field(default_factory=RunCounters)
    submitted: int = 0
    turn_s: float = 0.0
    ahead_s: float = 0.0
    """Of its turn, what leases that live were charged in advance."""

    @property
    def paid_s(self) -> float:
        """Its turn, as far as it is known what that took."""
        return self.turn_s - self.ahead_s


class RunBook:
    """Runs by id; one that nobody opened is there with the default terms as soon as it is asked for.

    After ``known_after`` executions of a run its quantiles mean something.
    """

    def __init__(self, known_after: int) -> None:
        self._known_after = known_after
        self._runs: dict[str, RunAccount] = {}
        self._served_s: dict[int, float] = {}
        """By priority: what the runs that were given leases had paid by then, the most of it."""

    def __iter__(self) -> Iterator[str]:
        return iter(self._runs)

    def __contains__(self, run_id: str) -> bool:
        return run_id in self._runs

    def of(self, run_id: str) -> RunAccount:
        run = self._runs.get(run_id)
        if run is None:
            run = self._runs[run_id] = RunAccount(SlotTimes(self._known_after))
        return run

    def open(self, run_id: str, terms: RunTerms) -> None:
        self.of(run_id).terms = terms

    def forget(self, run_id: str) -> None:
        """Drop a closed run."""
        self._runs.pop(run_id, None)

    @property
    def terms(self) -> Mapping[str, RunTerms]:
        return {run_id: run.terms for run_id, run in self._runs.items()}

    def turn(self, record: RolloutRecord) -> Turn:
        """Whose is least goes first: the higher priority, then the run that had less, then who came first."""
        run = self.of(record.key.run_id)
        return -run.terms.priority, run.turn_s, record.sequence

    def wake(self, run_id: str) -> None:
        """The run has something waiting again, after it had nothing."""
        run = self.of(run_id)
        run.turn_s = max(run.turn_s, self._served_s.get(run.terms.priority, 0.0))

    def charge(self, lease: LeaseRecord) -> None:
        """The run has one lease more: it is charged what one takes as a rule, and the rest when it ends."""
        run = self.of(lease.record.key.run_id)
        served_s = self._served_s.get(run.terms.priority, 0.0)
        self._served_s[run.terms.priority] = max(served_s, run.paid_s)
        lease.charged_s = run.times.mean_s / run.terms.weight
        run.turn_s += lease.charged_s
        run.ahead_s += lease.charged_s

    def settle(self, lease: LeaseRecord, now_s: float) -> None:
        """The lease is over: the run pays for the slot time that it took, whatever became of it."""
        run = self._runs.get(lease.record.key.run_id)
        if run is not None:
            took_s = 0.0 if lease.started_s is None else now_s - lease.started_s
            run.turn_s += took_s / run.terms.weight - lease.charged_s
            run.ahead_s -= lease.charged_s
