"""The manager in the simulation: the real intake, state machines and registry behind simulated streams."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.manager.control.commands import (
    AcknowledgeLease,
    CancelLease,
    DeliverResult,
    GiveLease,
    ManagerCommand,
    QuarantineWorker,
    SetDesired,
)
from embomatrix.manager.control.events import BatchSubmitted, LookaheadAnnounced, RunOpened
from embomatrix.manager.runtime.intake import TICK_S, Heartbeat, Intake
from embomatrix.manager.runtime.worker_link import OutgoingMessage
from embomatrix.manager.simulation.machines import SimulatedWorld
from embomatrix.rpc.wire.leases import LeaseProgress, LeaseRef, LeaseResult, WorkerState
from embomatrix.rpc.wire.values import Batch, LookaheadEntry, Resources, RolloutResult, RunTerms

if TYPE_CHECKING:
    from embomatrix.manager.runtime.registry import WorkerSession


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Receiving end of a worker. ``ended`` reports the end of its session."""

    take: Callable[[OutgoingMessage], None]
    ended: Callable[[], None]


class SimulatedManager:
    """Handles calls in simulated time and measures their CPU time.

    A manager with a ``pace`` handles them one after the other, any other at once.
    """

    def __init__(self, world: SimulatedWorld, intake: Intake) -> None:
        self._queue = world.queue
        self._checker = world.checker
        self._report = world.report
        self._pace = world.setting.scenario.manager
        self._free_s = 0.0
        """Time at which all calls so far are handled."""
        self._intake = intake
        self._streams: dict[str, Stream] = {}
        self._trainers: dict[str, Callable[[Sequence[RolloutResult]], None]] = {}

    def receive(self, call: Callable[[], None], *, results: int = 0) -> None:
        """Receive a worker's message with ``results`` results; make the call when earlier messages are handled."""
        cost_s = results * self._pace.rollout_s or self._pace.message_s
        if not cost_s:
            call()
            return
        now_s = self._queue.now_s
        begins_s = max(now_s, self._free_s)
        self._free_s = begins_s + cost_s
        self._report.lags_s.append(begins_s - now_s)
        self._queue.after(self._free_s - now_s, call)

    def tick_forever(self) -> None:
        """Tick now and at every interval from now on."""
        with self._report.deciding():
            lost, commands = self._intake.tick(now_s=self._queue.now_s)
        names = [event.worker_id for event in lost]
        for name in names:
            self._report.counts["workers lost"] += 1
            self._report.note_lost(name, self._queue.now_s)
            self._end_stream(name)
        self._carry_out(commands, lost=names)
        self._queue.after(TICK_S, self.tick_forever)

    def register(self, worker_id: str, boot_id: str, resources: Resources) -> WorkerSession:
        with self._report.deciding():
            session, commands = self._intake.register(worker_id, boot_id, resources, now_s=self._queue.now_s)
        self._report.note_lost(worker_id, self._queue.now_s)
        self._end_stream(worker_id)
        self._carry_out(commands, lost=(worker_id,))
        return session

    def drain(self, worker_id: str) -> None:
        """Drain the worker, as an operator would."""
        events = self._intake.registry.drain(worker_id)
        self._carry_out(self._intake.cluster.handle(*events, now_s=self._queue.now_s))

    def attach(self, session: WorkerSession, state: WorkerState, stream: Stream) -> None:
        """Open a stream with the worker's full state. Raise SupersededError."""
        session = self._intake.registry.find(session.session_id, session.epoch)
        self._end_stream(session.worker_id)
        self._streams[session.worker_id] = stream
        self._intake.registry.attach(session, now_s=self._queue.now_s)
        self.report(session, state, (), resync=True)

    def detach(self, session: WorkerSession, stream: Stream) -> None:
        if self._streams.get(session.worker_id) is stream:
            del self._streams[session.worker_id]
            self._intake.registry.detach(session, now_s=self._queue.now_s)

    def report(
        self,
        session: WorkerSession,
        state: WorkerState | None,
        results: Sequence[LeaseResult],
        *,
        resync: bool = False,
    ) -> None:
        """Raise SupersededError if the session is over."""
        if state is not None:
            self._checker.report(session.worker_id, state, resync=resync)
        with self._report.deciding():
            commands = self._intake.report(session, state, results, resync=resync, now_s=self._queue.now_s)
        self._carry_out(commands)

    def heartbeat(
        self, session: WorkerSession, held: tuple[LeaseRef, ...], progress: tuple[LeaseProgress, ...]
    ) -> float:
        """Raise SupersededError if the session is over."""
        with self._report.deciding():
            interval_s, commands = self._intake.heartbeat(
                session.session_id,
                session.epoch,
                Heartbeat(held, progress=progress),
                now_s=self._queue.now_s,
            )
        self._carry_out(commands)
        return interval_s

    def open_run(self, run_id: str, terms: RunTerms, take: Callable[[Sequence[RolloutResult]], None]) -> None:
        """Open a run; ``take`` receives its results."""
        self._trainers[run_id] = take
        self._checker.open_run(run_id, terms.group_policy)
        self._carry_out(self._intake.cluster.handle(RunOpened(run_id, terms), now_s=self._queue.now_s))

    def announce(self, run_id: str, version: int, entries: tuple[LookaheadEntry, ...]) -> None:
        with self._report.deciding():
            event = LookaheadAnnounced(run_id, version, entries)
            commands = self._intake.cluster.handle(event, now_s=self._queue.now_s)
        self._carry_out(commands)

    def submit(self, batch: Batch) -> None:
        self._checker.submit(batch)
        with self._report.deciding():
            commands = self._intake.cluster.handle(BatchSubmitted(batch), now_s=self._queue.now_s)
        self._carry_out(commands)

    def _end_stream(self, worker_id: str) -> None:
        stream = self._streams.pop(worker_id, None)
        if stream is not None:
            stream.ended()

    def _carry_out(self, commands: Sequence[ManagerCommand], *, lost: Iterable[str] = ()) -> None:
        self._checker.watch(commands, lost=lost)
        messages: dict[str, OutgoingMessage] = {}
        results: dict[str, list[RolloutResult]] = {}
        for command in commands:
            match command:
                case DeliverResult(run_id, _, result):
                    results.setdefault(run_id, []).append(result)
                case QuarantineWorker():
                    self._report.caught[command.worker_id] = command.audited
                case SetDesired() | GiveLease() | CancelLease() | AcknowledgeLease():
                    messages.setdefault(command.worker_id, OutgoingMessage()).add(command)
        for worker_id, message in messages.items():
            # Without a stream the message is lost; the worker's next full state shows that.
            stream = self._streams.get(worker_id)
            if stream is not None:
                stream.take(message)
        for run_id, found in results.items():
            self._trainers[run_id](found)
