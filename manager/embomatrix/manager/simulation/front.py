"""The manager in the simulation: its real intake, state machines and registry, with simulated streams around them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.commands import (
    AcknowledgeLease,
    CancelLease,
    DeliverResult,
    FinishBatch,
    GiveLease,
    QuarantineWorker,
    SetDesired,
)
from embomatrix.manager.control.events import BatchSubmitted, LookaheadAnnounced, RunOpened
from embomatrix.manager.runtime.intake import TICK_S, Heartbeat
from embomatrix.rpc.wire.leases import Lease

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from embomatrix.manager.control.commands import Command
    from embomatrix.manager.runtime.intake import Intake
    from embomatrix.manager.runtime.registry import WorkerSession
    from embomatrix.manager.simulation.agenda import Agenda
    from embomatrix.manager.simulation.auditor import InvariantChecker
    from embomatrix.manager.simulation.gauge import Gauge
    from embomatrix.manager.simulation.scenario import ManagerPace
    from embomatrix.rpc.wire.leases import LeaseProgress, LeaseRef, LeaseResult, WorkerState
    from embomatrix.rpc.wire.values import (
        Batch,
        LookaheadEntry,
        Resources,
        RolloutResult,
        RunTerms,
    )

REPORTS: Final = {True: "first report", False: "report"}


@dataclass(slots=True)
class Letter:
    """What a worker is told at once. ``desired`` is None when it did not change."""

    desired: tuple[str, ...] | None = None
    leases: list[Lease] = field(default_factory=list)
    ended: list[LeaseRef] = field(default_factory=list)
    """Acknowledged results: to be forgotten."""
    cancelled: list[LeaseRef] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Where a worker hears the manager. ``ended`` tells it that its session is over."""

    take: Callable[[Letter], None]
    ended: Callable[[], None]


class SimulatedManager:
    """Calls arrive here in simulated time; deciding costs real CPU, which the gauge notes.

    They are answered at once, or, by a manager that takes time, one after the other.
    """

    def __init__(
        self, agenda: Agenda, intake: Intake, auditor: InvariantChecker, gauge: Gauge, pace: ManagerPace
    ) -> None:
        self._agenda = agenda
        self._pace = pace
        self._free_s = 0.0
        """When the manager has dealt with all that came so far."""
        self._intake = intake
        self._auditor = auditor
        self._gauge = gauge
        self._streams: dict[str, Stream] = {}
        self._trainers: dict[str, Callable[[Sequence[RolloutResult]], None]] = {}

    def hear(self, call: Callable[[], None], *, results: int = 0) -> None:
        """A message of a worker has come, with so many results: the call is made when the manager has dealt with it."""
        takes_s = results * self._pace.rollout_s or self._pace.message_s
        if not takes_s:
            call()
            return
        now_s = self._agenda.now_s
        begins_s = max(now_s, self._free_s)
        self._free_s = begins_s + takes_s
        self._gauge.lags_s.append(begins_s - now_s)
        self._agenda.after(self._free_s - now_s, call)

    def keep_time(self) -> None:
        """Tick, for as long as the simulation runs."""
        with self._gauge.deciding("tick"):
            lost, commands = self._intake.tick(now_s=self._agenda.now_s)
        names = [event.worker_id for event in lost]
        for name in names:
            self._gauge.counts["workers lost"] += 1
            self._gauge.lost(name, self._agenda.now_s)
            self._end_stream(name)
        self._carry_out(commands, lost=names)
        self._agenda.after(TICK_S, self.keep_time)

    def register(self, worker_id: str, boot_id: str, resources: Resources) -> WorkerSession:
        with self._gauge.deciding("register"):
            session, commands = self._intake.register(worker_id, boot_id, resources, now_s=self._agenda.now_s)
        self._gauge.lost(worker_id, self._agenda.now_s)
        self._end_stream(worker_id)
        self._carry_out(commands, lost=(worker_id,))
        return session

    def drain(self, worker_id: str) -> None:
        """An operator takes the worker out."""
        events = self._intake.registry.drain(worker_id)
        self._carry_out(self._intake.feed(*events, now_s=self._agenda.now_s))

    def attach(self, session: WorkerSession, state: WorkerState, stream: Stream) -> None:
        """A stream opens with the worker's full state. Raises SupersededError."""
        session = self._intake.registry.find(session.session_id, session.epoch)
        self._end_stream(session.worker_id)
        self._streams[session.worker_id] = stream
        self._intake.registry.attach(session, now_s=self._agenda.now_s)
        self.report(session, state, (), resync=True)

    def detach(self, session: WorkerSession, stream: Stream) -> None:
        if self._streams.get(session.worker_id) is stream:
            del self._streams[session.worker_id]
            self._intake.registry.detach(session, now_s=self._agenda.now_s)

    def report(
        self,
        session: WorkerSession,
        state: WorkerState | None,
        results: Sequence[LeaseResult],
        *,
        resync: bool = False,
    ) -> None:
        """Raises SupersededError."""
        if state is not None:
            self._auditor.report(session.worker_id, state, resync=resync)
        with self._gauge.deciding("result" if state is None else REPORTS[resync]):
            commands = self._intake.report(session, state, results, resync=resync, now_s=self._agenda.now_s)
        self._carry_out(commands)

    def heartbeat(
        self, session: WorkerSession, held: tuple[LeaseRef, ...], progress: tuple[LeaseProgress, ...]
    ) -> float:
        """Raises SupersededError."""
        with self._gauge.deciding("heartbeat"):
            interval_s, commands = self._intake.heartbeat(
                session.session_id,
                session.epoch,
                Heartbeat(held, progress=progress),
                now_s=self._agenda.now_s,
            )
        self._carry_out(commands)
        return interval_s

    def open_run(self, run_id: str, terms: RunTerms, take: Callable[[Sequence[RolloutResult]], None]) -> None:
        """The run's results are handed to ``take`` as they come."""
        self._trainers[run_id] = take
        self._auditor.open_run(run_id, terms.group_policy)
        self._carry_out(self._intake.feed(RunOpened(run_id, terms), now_s=self._agenda.now_s))

    def announce(self, run_id: str, version: int, entries: tuple[LookaheadEntry, ...]) -> None:
        with self._gauge.deciding("look-ahead"):
            event = LookaheadAnnounced(run_id, version, entries)
            commands = self._intake.feed(event, now_s=self._agenda.now_s)
        self._carry_out(commands)

    def submit(self, batch: Batch) -> None:
        self._auditor.submit(batch)
        with self._gauge.deciding("batch"):
            commands = self._intake.feed(BatchSubmitted(batch), now_s=self._agenda.now_s)
        self._carry_out(commands)

    def _end_stream(self, worker_id: str) -> None:
        stream = self._streams.pop(worker_id, None)
        if stream is not None:
            stream.ended()

    def _carry_out(self, commands: Sequence[Command], *, lost: Iterable[str] = ()) -> None:
        self._auditor.watch(commands, lost=lost)
        letters: dict[str, Letter] = {}
        results: dict[str, list[RolloutResult]] = {}
        for command in commands:
            match command:
                case DeliverResult(run_id, _, result):
                    results.setdefault(run_id, []).append(result)
                case FinishBatch():
                    pass
                case QuarantineWorker():
                    self._gauge.caught[command.worker_id] = command.audited
                case _:
                    _write(letters.setdefault(command.worker_id, Letter()), command)
        for worker_id, letter in letters.items():
            # Without a stream the command is lost; the worker's next full state shows that.
            stream = self._streams.get(worker_id)
            if stream is not None:
                stream.take(letter)
        for run_id, found in results.items():
            self._trainers[run_id](found)


def _write(letter: Letter, command: SetDesired | GiveLease | CancelLease | AcknowledgeLease) -> None:
    match command:
        case SetDesired(_, scenes):
            letter.desired = scenes
        case GiveLease(_, ref, rollout, deadline_s):
            letter.leases.append(Lease(ref, rollout, deadline_s))
        case CancelLease(_, ref):
            letter.cancelled.append(ref)
        case AcknowledgeLease(_, ref):
            letter.ended.append(ref)
