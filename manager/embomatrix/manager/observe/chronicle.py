"""What happened, by run: a bounded log of events and the figures beside it. It decides nothing.

The runtime tells it what goes in and out of the state machines. Leases outnumber everything else: of each there are two
events, and of a rollout a handful of counts.
"""

from __future__ import annotations

import itertools
import logging
from collections import Counter, OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.manager.observe.event_ring import EventRing
from embomatrix.manager.observe.fleet_log import FleetLog
from embomatrix.manager.observe.histogram import Histogram, merged
from embomatrix.manager.observe.run_figures import RunFigures
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.run_log import EventKind, RolloutPhase, RunEvent
from embomatrix.rpc.wire.values import Cancelled, Completed, InfraFailure

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from embomatrix.manager.control.commands import DeliverResult, GiveLease
    from embomatrix.manager.control.dispatch.records import LeaseRecord
    from embomatrix.rpc.leases import LeaseResult
    from embomatrix.rpc.run_log import EventPage
    from embomatrix.rpc.wire.values import Batch

logger = logging.getLogger(__name__)

EVENTS_KEPT: Final = 32_768
"""Events of all open runs together, at about 350 bytes each; every run may keep at least ``LEAST_KEPT`` of its own."""
LEAST_KEPT: Final = 256
HEDGES_KEPT: Final = 4096
PAGE: Final = 4096
"""Events that a message carries at most."""
MESSAGE_CHARS: Final = 500


@dataclass(frozen=True, slots=True)
class RunRecord:
    """An open run. ``cpu_s`` is what the manager had used when it was opened; ``opened_s`` is of the monotonic clock."""

    run_id: str
    name: str
    opened_s: float
    cpu_s: float
    ring: EventRing
    figures: RunFigures
    reward: RewardSettings = PAPER


class Chronicle:
    """``epoch_s`` is the wall clock's time at second 0 of the monotonic clock that every ``now_s`` is of."""

    def __init__(self, *, epoch_s: float) -> None:
        self.epoch_s = epoch_s
        self._sequences = itertools.count(1)
        self.fleet = FleetLog(self._sequences, epoch_s=epoch_s)
        self.attempts: Counter[int] = Counter()
        """Rollouts by the attempt that brought their outcome."""
        self.execute_s = 0.0
        """Seconds that slots worked for results."""
        self.hedges_won = 0
        """Results of second leases, given while the first was late and still good."""
        self._hedges: OrderedDict[str, None] = OrderedDict()
        """Second leases that may still bring one."""
        self.dropped = 0
        """Events that logs of runs which are closed by now had dropped."""
        self._runs: dict[str, RunRecord] = {}
        self._closed: dict[RolloutPhase, Histogram] = {phase: Histogram() for phase in RolloutPhase}

    @property
    def runs(self) -> Mapping[str, RunRecord]:
        """Those that are open."""
        return self._runs

    def phases(self) -> dict[RolloutPhase, Histogram]:
        """Of all runs that this manager has seen."""
        every = [self._closed, *(run.figures.phases for run in self._runs.values())]
        return {phase: merged(phases[phase] for phases in every) for phase in RolloutPhase}

    def page(self, run_id: str, after: int, limit: int = PAGE) -> EventPage | None:
        """Events of an open run, or of the fleet for an empty id; None when no such run is open."""
        if not run_id:
            return self.fleet.ring.after(after, limit)
        return self._runs[run_id].ring.after(after, limit) if run_id in self._runs else None

    def open_run(
        self, run_id: str, name: str, *, now_s: float, cpu_s: float, reward: RewardSettings = PAPER
    ) -> None:
        """Begin a log; one that was begun goes on."""
        if run_id in self._runs:
            return
        limit = max(LEAST_KEPT, EVENTS_KEPT // (len(self._runs) + 1))
        for run in self._runs.values():
            run.ring.limit = limit
        self._runs[run_id] = RunRecord(
            run_id, name, now_s, cpu_s, EventRing(limit), RunFigures(now_s), reward
        )
        self._note(EventKind.RUN_OPENED, run_id, now_s=now_s, message=name)

    def close_run(self, run_id: str, *, now_s: float) -> RunRecord | None:
        """End a log and forget it here; None when there is none."""
        self._note(EventKind.RUN_CLOSED, run_id, now_s=now_s)
        run = self._runs.pop(run_id, None)
        if run is not None:
            self.dropped += run.ring.dropped
            for phase, histogram in run.figures.phases.items():
                self._closed[phase].add(histogram)
        return run

    def submitted(self, batch: Batch, *, now_s: float) -> None:
        self._note(
            EventKind.SUBMITTED, batch.run_id, now_s=now_s, batch_id=batch.batch_id, size=len(batch.rollouts)
        )

    def leased(self, command: GiveLease, *, now_s: float) -> None:
        origin = command.origin
        if command.hedge:
            self._hedges[command.ref.lease_id] = None
            while len(self._hedges) > HEDGES_KEPT:
                self._hedges.popitem(last=False)
        run = self._runs.get(origin.run_id)
        if run is not None:
            run.ring.append(
                RunEvent(
                    next(self._sequences),
                    self.epoch_s + now_s,
                    EventKind.LEASED,
                    origin.run_id,
                    origin.batch_id,
                    origin.rollout_id,
                    command.worker_id,
                    command.rollout.bundle_digest,
                    0,
                    origin.attempt,
                )
            )

    def reported(
        self, worker_id: str, results: Iterable[LeaseResult], live: Mapping[str, LeaseRecord], *, now_s: float
    ) -> None:
        """A worker tells how leases ended; to be called before the state machines hear of it and end them."""
        for result in results:
            lease = live.get(result.ref.lease_id)
            if lease is None or lease.record.check:
                continue
            if lease.ref == result.ref and lease.worker_id == worker_id:
                self._ended_lease(result, lease, now_s)

    def delivered(self, command: DeliverResult, *, now_s: float) -> None:
        """A rollout reached its outcome."""
        run = self._runs.get(command.run_id)
        if run is None:
            return
        result = command.result
        match result.outcome:
            case Completed(timings=timings):
                self.attempts[result.attempt] += 1
                self.execute_s += timings.execute_s
                run.figures.completed(timings, now_s)
            case InfraFailure(code, message, worker_id):
                self.attempts[result.attempt] += 1
                run.figures.series.count(now_s, failed=1)
                ended = self._end(command, now_s, code.value, message, worker_id)
                run.figures.failures.append(ended)
            case Cancelled():
                self._end(command, now_s, "cancelled", "", "")

    def in_log(self, run_id: str, durations_s: Sequence[float]) -> None:
        """So long after their arrival, results of the run were in the log for its trainer."""
        run = self._runs.get(run_id)
        if run is not None:
            histogram = run.figures.phases[RolloutPhase.DELIVER]
            for seconds in durations_s:
                histogram.observe(seconds)

    def _ended_lease(self, result: LeaseResult, lease: LeaseRecord, now_s: float) -> None:
        record = lease.record
        run = self._runs.get(record.key.run_id)
        if run is None:
            return
        worker = run.figures.worker(lease.worker_id)
        code, message, timings = "", "", None
        if isinstance(result.outcome, Completed):
            timings = lease.timings(result.outcome.timings, now_s)
            worker.completed += 1
            worker.execute_s += timings.execute_s
            worker.load_s += timings.load_s
            self.hedges_won += result.ref.lease_id in self._hedges
        else:
            code, message = result.outcome.code.value, result.outcome.message[:MESSAGE_CHARS]
            worker.failed += 1
        self._hedges.pop(result.ref.lease_id, None)
        event = RunEvent(
            next(self._sequences),
            self.epoch_s + now_s,
            EventKind.FAILED if code else EventKind.COMPLETED,
            *record.key,
            lease.worker_id,
            record.rollout.bundle_digest,
            result.slot,
            record.attempts + 1,
            code,
            message,
            timings,
            result.held_s,
        )
        run.ring.append(event)
        if code:
            run.figures.failures.append(event)
            _say_failed(event)

    def _end(self, command: DeliverResult, now_s: float, code: str, message: str, worker_id: str) -> RunEvent:
        return self._note(
            EventKind.ENDED,
            command.run_id,
            now_s=now_s,
            batch_id=command.batch_id,
            rollout_id=command.result.rollout_id,
            worker_id=worker_id,
            attempt=command.result.attempt,
            code=code,
            message=message,
        )

    def _note(
        self,
        kind: EventKind,
        run_id: str,
        *,
        now_s: float,
        batch_id: str = "",
        rollout_id: str = "",
        worker_id: str = "",
        attempt: int = 0,
        code: str = "",
        message: str = "",
        size: int = 0,
    ) -> RunEvent:
        """An event that is rare."""
        event = RunEvent(
            next(self._sequences),
            self.epoch_s + now_s,
            kind,
            run_id,
            batch_id,
            rollout_id,
            worker_id,
            attempt=attempt,
            code=code,
            message=message[:MESSAGE_CHARS],
            size=size,
        )
        if run_id in self._runs:
            self._runs[run_id].ring.append(event)
        return event


def _say_failed(event: RunEvent) -> None:
    logger.warning(
        "lease failed run=%s batch=%s rollout=%s attempt=%d worker=%s slot=%d scene=%s code=%s: %s",
        event.run_id,
        event.batch_id,
        event.rollout_id,
        event.attempt,
        event.worker_id,
        event.slot,
        event.bundle_digest,
        event.code,
        event.message,
    )
