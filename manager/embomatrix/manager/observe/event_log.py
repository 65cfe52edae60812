"""Run history log: bounded events and figures of each open run, and of workers and scenes. It decides nothing.

The runtime reports the events and commands of the state machines. Each lease has two events.
"""

from __future__ import annotations

import functools
import itertools
import logging
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from embomatrix.manager.control.commands import DeliverResult, GiveLease
from embomatrix.manager.control.dispatch.records import LeaseRecord
from embomatrix.manager.histogram import Histogram, merged
from embomatrix.manager.observe.run_figures import RunFigures
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.leases import LeaseResult
from embomatrix.rpc.wire.run_log import EventKind, EventPage, RolloutPhase, RunEvent
from embomatrix.rpc.wire.values import (
    Batch,
    Completed,
    InfraCode,
    InfraFailure,
    Resident,
    ResidentState,
    Resources,
)

logger = logging.getLogger(__name__)

EVENTS_KEPT: Final = 32_768
"""Events of all open runs together, about 350 bytes each. Every run may keep at least ``LEAST_KEPT``."""
LEAST_KEPT: Final = 256
FLEET_EVENTS_KEPT: Final = 4096
HEDGES_KEPT: Final = 4096
PAGE: Final = 4096
"""Events of one page at most."""
MESSAGE_CHARS: Final = 500


@dataclass(frozen=True, slots=True)
class RunRecord:
    """Open run. ``cpu_s`` is the manager's CPU time when it was opened; ``opened_s`` is on the monotonic clock."""

    run_id: str
    name: str
    opened_s: float
    cpu_s: float
    ring: EventRing
    figures: RunFigures
    reward: RewardSettings = PAPER


class RunEventLog:
    """``epoch_s`` is the wall-clock time at second 0 of the monotonic clock of every ``now_s``."""

    def __init__(self, *, epoch_s: float) -> None:
        self.epoch_s = epoch_s
        self.fleet = EventRing(FLEET_EVENTS_KEPT)
        """Events of workers and scenes."""
        self.scene_load = Histogram()
        self._sequences = itertools.count(1)
        self._residents: dict[str, dict[str, ResidentState]] = {}
        self.attempts: Counter[int] = Counter()
        """Rollouts by number of attempts."""
        self.execute_s = 0.0
        """Seconds that slots spent on results."""
        self.hedges_won = 0
        """Results of hedge leases that arrived first."""
        self._hedges: OrderedDict[str, None] = OrderedDict()
        """Hedge leases that may still deliver."""
        self.dropped = 0
        """Events that were discarded from the logs of closed runs."""
        self._runs: dict[str, RunRecord] = {}
        self._closed: dict[RolloutPhase, Histogram] = {phase: Histogram() for phase in RolloutPhase}

    @property
    def runs(self) -> Mapping[str, RunRecord]:
        """Open runs by id."""
        return self._runs

    def phases(self) -> dict[RolloutPhase, Histogram]:
        """Return the durations of all runs of this manager, by phase."""
        every = [self._closed, *(run.figures.phases for run in self._runs.values())]
        return {phase: merged(phases[phase] for phases in every) for phase in RolloutPhase}

    def page(self, run_id: str, after: int, limit: int = PAGE) -> EventPage | None:
        """Return events of an open run, or of workers and scenes for an empty id; None if the run is not open."""
        if not run_id:
            return self.fleet.after(after, limit)
        return self._runs[run_id].ring.after(after, limit) if run_id in self._runs else None

    def open_run(
        self, run_id: str, name: str, *, now_s: float, cpu_s: float, reward: RewardSettings = PAPER
    ) -> None:
        """Start the log of a run, unless it exists."""
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
        """End a run's log and remove it; None if there is none."""
        self._note(EventKind.RUN_CLOSED, run_id, now_s=now_s)
        run = self._runs.pop(run_id, None)
        if run is not None:
            self.dropped += run.ring.dropped
            for phase, histogram in run.figures.phases.items():
                self._closed[phase].add(histogram)
        return run

    def submitted(self, batch: Batch, *, now_s: float) -> None:
        self._note(EventKind.SUBMITTED, batch.run_id, now_s=now_s, batch_id=batch.batch_id, size=batch.count)

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
        """Log the ended leases of a worker's report. Call it before the state machines end these leases."""
        for result in results:
            lease = live.get(result.ref.lease_id)
            if lease is None or lease.record.check:
                continue
            if lease.ref == result.ref and lease.worker_id == worker_id:
                self._ended_lease(result, lease, now_s)

    def delivered(self, command: DeliverResult, *, now_s: float) -> None:
        """Log the outcome of a rollout."""
        run = self._runs.get(command.run_id)
        if run is None:
            return
        result = command.result
        code, message, worker_id = "cancelled", "", ""
        match result.outcome:
            case Completed(timings=timings):
                self.attempts[result.attempt] += 1
                self.execute_s += timings.execute_s
                run.figures.completed(timings, now_s, result.count)
                return
            case InfraFailure(failure, message, worker_id):
                self.attempts[result.attempt] += 1
                run.figures.series.count(now_s, failed=result.count)
                code = failure.value
        event = self._note(
            EventKind.ENDED,
            command.run_id,
            now_s=now_s,
            batch_id=command.batch_id,
            rollout_id=result.rollout_id,
            worker_id=worker_id,
            attempt=result.attempt,
            code=code,
            message=message[:MESSAGE_CHARS],
        )
        if isinstance(result.outcome, InfraFailure):
            run.figures.failures.append(event)

    def count_deliveries(self, run_id: str, durations_s: Sequence[float]) -> None:
        """Count the delivery times, in seconds, of results that reached the run's result log."""
        run = self._runs.get(run_id)
        if run is not None:
            histogram = run.figures.phases[RolloutPhase.DELIVER]
            for seconds in durations_s:
                histogram.observe(seconds)

    def joined(self, worker_id: str, resources: Resources, *, now_s: float) -> None:
        self._residents.pop(worker_id, None)
        self._note(EventKind.WORKER_JOINED, worker_id=worker_id, now_s=now_s, size=resources.slots)

    def lost(self, worker_id: str, reason: str, *, now_s: float) -> None:
        self._residents.pop(worker_id, None)
        message = reason[:MESSAGE_CHARS]
        self._note(EventKind.WORKER_LOST, worker_id=worker_id, now_s=now_s, message=message)

    def residents(self, worker_id: str, residents: Sequence[Resident], *, now_s: float) -> None:
        """Log the changes of a worker's scenes since its last report."""
        before = self._residents.get(worker_id, {})
        after = {resident.bundle_digest: resident.state for resident in residents}
        self._residents[worker_id] = after
        note = functools.partial(self._note, worker_id=worker_id, now_s=now_s)
        for resident in residents:
            scene = resident.bundle_digest
            if before.get(scene) is resident.state:
                continue
            if resident.state is ResidentState.WARM:
                self.scene_load.observe(resident.load_s)
                note(EventKind.SCENE_WARM, bundle_digest=scene, held_s=resident.load_s)
            elif resident.state is ResidentState.FAILED:
                note(EventKind.SCENE_FAILED, bundle_digest=scene, message=resident.error[:MESSAGE_CHARS])
        for scene, state in before.items():
            if scene not in after and state is ResidentState.WARM:
                note(EventKind.SCENE_EVICTED, bundle_digest=scene)

    def _ended_lease(self, result: LeaseResult, lease: LeaseRecord, now_s: float) -> None:
        record = lease.record
        run = self._runs.get(record.key.run_id)
        if run is None:
            return
        worker = run.figures.worker(lease.worker_id)
        code, message, timings = "", "", None
        if isinstance(result.outcome, Completed):
            timings = lease.timings(result.outcome.timings, now_s)
            worker.completed += record.count
            worker.execute_s += timings.execute_s
            worker.load_s += timings.load_s
            self.hedges_won += result.ref.lease_id in self._hedges
        else:
            code, message = result.outcome.code.value, result.outcome.message[:MESSAGE_CHARS]
            worker.failed += record.count
        self._hedges.pop(result.ref.lease_id, None)
        if record.rollout.is_turn and code in ("", InfraCode.PREFIX_MISMATCH):
            return  # its client has the answer, and thousands of turns a second would displace all other events
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
            _log_failed(event)

    def _note(self, kind: EventKind, run_id: str = "", *, now_s: float, **fields: Any) -> RunEvent:
        """Log an infrequent event of a run, or of workers and scenes for an empty id."""
        event = RunEvent(next(self._sequences), self.epoch_s + now_s, kind, run_id, **fields)
        if not run_id:
            self.fleet.append(event)
        elif run_id in self._runs:
            self._runs[run_id].ring.append(event)
        return event


def _log_failed(event: RunEvent) -> None:
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


class EventRing:
    """Events by rising sequence number. Beyond ``limit``, which may change, the oldest are discarded."""

    __slots__ = ("dropped", "events", "limit")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.dropped = 0
        self.events: deque[RunEvent] = deque()

    def append(self, event: RunEvent) -> None:
        self.events.append(event)
        while len(self.events) > self.limit:
            self.events.popleft()
            self.dropped += 1

    def after(self, sequence: int, limit: int) -> EventPage:
        """Return the first events after the sequence number."""
        found: list[RunEvent] = []
        for event in self.events:
            if event.sequence > sequence:
                found.append(event)
                if len(found) == limit:
                    break
        return EventPage(tuple(found), self.dropped)
