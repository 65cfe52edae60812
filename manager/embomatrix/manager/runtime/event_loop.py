"""Owner of the state machines: feeds them events, executes their commands, and drives the clock.

Everything runs on one event loop and never awaits between an event and its commands, so it needs no lock.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.commands import (
    AcknowledgeLease,
    CancelLease,
    DeliverResult,
    FinishBatch,
    GiveLease,
    ManagerCommand,
    QuarantineWorker,
    SetDesired,
)
from embomatrix.manager.control.events import Event, PauseChanged, WorkerFaulted
from embomatrix.manager.observe.event_log import RunEventLog
from embomatrix.manager.observe.hosts import HostBook
from embomatrix.manager.observe.metrics import ErrorCount, ManagerLoad, Meter
from embomatrix.manager.observe.run_archive import RunArchive, RunHistory
from embomatrix.manager.observe.training_reports import TrainingBook
from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.manager.runtime.intake import TICK_S, Heartbeat, Intake
from embomatrix.manager.runtime.open_turns import OpenTurns
from embomatrix.manager.runtime.registry import Registry, WorkerSession, WorkerStanding
from embomatrix.manager.runtime.results import ResultDelivery, ResultLogs
from embomatrix.manager.runtime.runs import Runs
from embomatrix.manager.runtime.state_journal import StateJournal
from embomatrix.manager.runtime.worker_link import WorkerCommand, WorkerLink
from embomatrix.manager.store.opening import timed_store
from embomatrix.manager.store.protocol import FencedError, StateStore
from embomatrix.rpc.status import ClusterError, InternalError, SupersededError, UnavailableError
from embomatrix.rpc.wire.leases import LeaseResult, WorkerState
from embomatrix.rpc.wire.values import Resources

logger = logging.getLogger(__name__)

UNAUDITED: Final = "results are not audited: auditing needs a second worker"
RESULTS_KEPT: Final = 500_000
CLEANUP_S: Final = 5.0
STALLED_S: Final = 1.0
"""A tick that is this late means that no worker was heard meanwhile."""
LET_GO_S: Final = 30.0
"""A manager without its store for this long disconnects its workers, which then turn to another manager. Equals the
life of a lease."""
STORE_AWAY: Final = (
    "the manager cannot reach its store, and another one may lead: try again, or try the other managers"
)
_SUSPENSION: Final = {True: ("suspended", "is away"), False: ("resumes", "is back")}


class ManagerRuntime:
    """Entry point of the services. Call ``start`` first, then run ``serve``.

    Results are kept for ``results_ttl_s`` after their batch ended, ``RESULTS_KEPT`` of them at most. ``lapsed_s``
    returns how long another manager may have led, and ``unrenewed`` why; nothing is dispatched meanwhile.
    """

    def __init__(
        self,
        cluster: ClusterState,
        registry: Registry,
        store: StateStore,
        bundles: BundleStore,
        archive: RunArchive,
        *,
        results_ttl_s: float = 3600.0,
        lapsed_s: Callable[[], float] = lambda: 0.0,
        unrenewed: Callable[[], str] = str,
    ) -> None:
        logs = ResultLogs(ttl_s=results_ttl_s, limit=RESULTS_KEPT)
        self.cluster = cluster
        self.registry = registry
        self.bundles = bundles
        bundles.protect(cluster.needed_scenes)
        self.meter = Meter()
        self.training = TrainingBook()
        self.hosts = HostBook()
        self.load = ManagerLoad()
        self.errors = ErrorCount()
        store = timed_store(store, self.load.operated)
        self.started_s = time.monotonic()
        self.event_log = RunEventLog(epoch_s=time.time() - self.started_s)
        self.history = RunHistory(self.event_log, archive, cluster, self.training)
        self.runs = Runs(cluster, store, bundles, logs, self._carry_out, self.history)
        self.turns = OpenTurns(self.runs, self._feed)
        self._intake = Intake(cluster, registry)
        self._journal = StateJournal(store, registry, cluster)
        self._delivery = ResultDelivery(store, logs, self._send, self.event_log.count_deliveries)
        self._links: dict[str, WorkerLink] = {}
        self._lapsed_s = lapsed_s
        self._unrenewed = unrenewed
        self._suspended = False
        self.paused = False
        """True if an operator paused dispatch."""
        self._warned_unaudited = False

    async def start(self) -> None:
        """Restore the state of a former manager."""
        self._carry_out(self.cluster.handle(await self._journal.reputations(), now_s=time.monotonic()))
        self.paused = await self._journal.paused()
        self._update_dispatch()
        await self.runs.restore()

    async def serve(self) -> None:
        """Drive the clock and write results until cancelled. Raises FencedError after another manager took over."""
        with self.errors:
            await self._serve()

    async def _serve(self) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(self._keep_time())
            group.create_task(self._keep_clean())
            group.create_task(self._journal.serve())
            group.create_task(self._delivery.serve())
            group.create_task(self.runs.serve())

    async def register(
        self,
        worker_id: str,
        boot_id: str,
        resources: Resources,
        *,
        credential_id: str = "",
    ) -> tuple[WorkerSession, float]:
        """Open a session for a worker. Return it and the heartbeat interval in seconds after the worker has been
        journaled.
        """
        if self._lapsed_s() > LET_GO_S:
            raise UnavailableError(STORE_AWAY)
        session, commands = self._intake.register(worker_id, boot_id, resources, now_s=time.monotonic())
        session.credential_id = credential_id
        self._close_link(worker_id)
        self.event_log.joined(worker_id, resources, now_s=time.monotonic())
        self._carry_out(commands)
        logger.info("worker registered worker=%s slots=%d", worker_id, resources.slots)
        await self._journal.wait_until_noted(worker_id)
        return session, self.registry.interval_s

    @contextlib.contextmanager
    def attached(self, session: WorkerSession) -> Iterator[WorkerLink]:
        """Hold the worker's stream open."""
        self._close_link(session.worker_id)
        link = self._links[session.worker_id] = WorkerLink(session)
        self.registry.attach(session, now_s=time.monotonic())
        if session.drained:
            link.drain()
        try:
            yield link
        finally:
            if self._links.get(session.worker_id) is link:
                del self._links[session.worker_id]
                self.registry.detach(session, now_s=time.monotonic())
                logger.info("session stream ended worker=%s", session.worker_id)

    def process_report(
        self, link: WorkerLink, state: WorkerState | None, results: Sequence[LeaseResult], *, resync: bool
    ) -> None:
        """Process a worker's message, or a slice of it; ``deliver`` follows the last slice. ``resync`` marks the
        first message.
        """
        now_s, worker_id = time.monotonic(), link.session.worker_id
        ended = (*state.finished, *results) if state is not None else results
        with self._fault_barrier(link.session):
            self.event_log.reported(worker_id, ended, self.cluster.dispatcher.live_leases, now_s=now_s)
            commands = self._intake.report(link.session, state, results, resync=resync, now_s=now_s)
            if state is not None:
                self.event_log.residents(worker_id, state.residents, now_s=now_s)
            self._carry_out(commands, more=True)

    def deliver(self) -> None:
        """Write the results of a worker's message in one transaction, after its last slice."""
        self._delivery.flush()

    def process_heartbeat(self, session_id: str, epoch: int, beat: Heartbeat) -> float:
        """Renew the leases that the worker names. Return the seconds until the next heartbeat."""
        session = self.registry.find(session_id, epoch)
        with self._fault_barrier(session):
            interval_s, commands = self._intake.heartbeat(session_id, epoch, beat, now_s=time.monotonic())
            self._carry_out(commands)
            self.hosts.note(
                session.worker_id,
                session.boot_id,
                session_id,
                beat.host,
                beat.log_lines,
                at_s=time.time(),
            )
        return interval_s

    def end_session(
        self,
        session: WorkerSession,
        reason: str,
        error: ClusterError,
        standing: WorkerStanding = WorkerStanding.LOST,
    ) -> None:
        """End the session at once: its stream ends with the error and its leases are re-dispatched."""
        events = self.registry.end(session, reason, standing)
        if events:
            logger.info("session ended worker=%s: %s", session.worker_id, reason)
            self._carry_out(self.cluster.handle(*events, now_s=time.monotonic()))
            self._close_link(session.worker_id, error)

    @contextlib.contextmanager
    def _fault_barrier(self, session: WorkerSession) -> Iterator[None]:
        """Keep the manager alive if a worker's message breaks a state machine: quarantine the worker and disconnect it.

        Its leases are re-dispatched, so a half-processed message leaves no rollout without a place. Raises
        InternalError instead of the original error.
        """
        try:
            yield
        except ClusterError:
            raise
        except Exception as error:
            worker_id = session.worker_id
            logger.exception("message of worker %s broke the state machine", worker_id)
            reason = f"its message broke the manager's state machine ({type(error).__name__})"
            self._survive(WorkerFaulted(worker_id, reason))
            fault = InternalError(f"worker {worker_id} is quarantined: {reason}, see the manager's log")
            self._survive(*self.registry.end(session, reason))
            self._close_link(worker_id, fault)
            raise fault from error

    def _survive(self, *events: Event) -> None:
        """Apply events; log an error instead of raising it."""
        try:
            self._carry_out(self.cluster.handle(*events, now_s=time.monotonic()))
        except Exception:
            logger.exception(
                "state machine failed on %s", ", ".join(type(event).__name__ for event in events)
            )

    def drain_worker(self, worker_id: str) -> None:
        """Give the worker no new leases, and have it leave after its last one."""
        self._carry_out(self.cluster.handle(*self.registry.drain(worker_id), now_s=time.monotonic()))
        if worker_id in self._links:
            self._links[worker_id].drain()

    def resume_worker(self, worker_id: str) -> None:
        """Cancel the drain, or lift the quarantine, of a worker that has not left."""
        self._carry_out(self.cluster.handle(*self.registry.resume(worker_id), now_s=time.monotonic()))
        if worker_id in self._links:
            self._links[worker_id].resume()
        self._journal.flush()

    @property
    def store_problem(self) -> str:
        """Problem of the state store; empty while it can be written."""
        if self._suspended and not self._delivery.problem:
            return self._unrenewed() or "the state store is away"
        return self._delivery.problem

    async def set_paused(self, paused: bool) -> None:
        """Stop giving leases, also under later managers, or give them again. Live leases continue.

        Raises UnavailableError if the change can't be stored for later managers.
        """
        self.paused = paused
        self._update_dispatch()
        await self._journal.note_pause(paused)

    def _update_dispatch(self) -> None:
        self._feed(PauseChanged(self.paused or self._suspended))

    def _carry_out(self, commands: Sequence[ManagerCommand], *, more: bool = False) -> None:
        now_s = time.monotonic()
        if logger.isEnabledFor(logging.DEBUG):
            for command in commands:
                logger.debug("%.200s because of %s", command, type(command.cause).__name__)
        for command in commands:
            match command:
                case SetDesired() | CancelLease():
                    self._send(command)
                case GiveLease():
                    self._send(command)
                    if not (command.audit or command.rollout.is_turn):
                        self.event_log.leased(command, now_s=now_s)
                case AcknowledgeLease():
                    self._delivery.put_acknowledgement(command)
                case DeliverResult():
                    self.meter.observe(command.run_id, command.result, now_s)
                    self.event_log.delivered(command, now_s=now_s)
                    if not self.turns.take(command):
                        self._delivery.put(command)
                case FinishBatch():
                    if not self.turns.take(command):
                        self._delivery.put(command)
                case QuarantineWorker():
                    logger.error("worker quarantined worker=%s: %s", command.worker_id, command.reason)
                    self._journal.flush()
        if not more:
            self._delivery.flush()

    def _feed(self, event: Event) -> None:
        self._carry_out(self.cluster.handle(event, now_s=time.monotonic()))

    def _send(self, command: WorkerCommand) -> None:
        """Send a command. Without a stream the command is lost; the worker's next full state shows that, and it is
        repeated.
        """
        link = self._links.get(command.worker_id)
        if link is not None:
            link.put(command)

    def _close_link(self, worker_id: str, reason: ClusterError | None = None) -> None:
        link = self._links.pop(worker_id, None)
        if link is not None:
            taken = f"another session of worker {worker_id} took over: stop this one"
            link.close(reason or SupersededError(taken))

    def _watch_leadership(self) -> None:
        """Suspend dispatch while another manager may lead, and disconnect the workers after ``LET_GO_S``."""
        lapsed_s = self._lapsed_s()
        if (lapsed_s > 0.0) != self._suspended:
            self._suspended = not self._suspended
            logger.warning("dispatch %s: the store %s", *_SUSPENSION[self._suspended])
            self._update_dispatch()
        if lapsed_s > LET_GO_S:
            for worker_id in list(self._links):
                self.registry.detach(self._links[worker_id].session, now_s=time.monotonic())
                self._close_link(worker_id, UnavailableError(STORE_AWAY))

    def _warn_unaudited(self) -> None:
        if self.cluster.dispatcher.auditor.lone and not self._warned_unaudited:
            self._warned_unaudited = True
            logger.warning(UNAUDITED)

    async def _keep_time(self) -> None:
        while True:
            due_s = time.monotonic() + TICK_S
            await asyncio.sleep(TICK_S)
            late_s = time.monotonic() - due_s
            self.load.lagged(late_s)
            if late_s >= STALLED_S:
                logger.warning(
                    "the manager did not run for %.1f s: is its machine paused, or short of memory?", late_s
                )
                self.registry.excuse_silence(late_s, now_s=time.monotonic())
            try:
                self._watch_leadership()
                self._warn_unaudited()
                self._tick()
            except Exception:
                # A tick repeats everything that a failed one left undone.
                logger.exception("clock tick failed")

    def _tick(self) -> None:
        lost, commands = self._intake.tick(now_s=time.monotonic())
        for event in lost:
            logger.warning("worker lost worker=%s: %s", event.worker_id, event.reason)
            self.event_log.lost(event.worker_id, event.reason, now_s=time.monotonic())
            self._close_link(event.worker_id)
        self._carry_out(commands)

    async def _keep_clean(self) -> None:
        while True:
            self.load.sample(time.monotonic(), time.process_time(), self.event_log.execute_s)
            await asyncio.sleep(CLEANUP_S)
            try:
                await self._delivery.give_up_outdated(time.monotonic())
                await self.runs.close_idle(time.monotonic())
            except FencedError:
                raise
            except Exception:
                logger.exception("cleaning up failed, the next time is in %g s", CLEANUP_S)
