"""Simulated worker daemon: joins, keeps its session, resends results until they are acknowledged, and may die."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Final, TypeVar

from embomatrix.host.backoff import Backoff
from embomatrix.manager.runtime.registry import WorkerSession
from embomatrix.manager.runtime.worker_link import OutgoingMessage
from embomatrix.manager.simulation.machines import SimulatedMachine, SimulatedWorld
from embomatrix.manager.simulation.manager import SimulatedManager, Stream
from embomatrix.manager.simulation.network import NetworkPath
from embomatrix.manager.simulation.slots import SimulatedSlots
from embomatrix.rpc.status import SupersededError
from embomatrix.rpc.wire.leases import LeaseRef, LeaseResult, WorkerState
from embomatrix.rpc.wire.values import Completed

ANSWER_S: Final = 2.0
"""Timeout of a heartbeat and of a new stream."""
REGISTER_S: Final = 10.0
MISSES: Final = 3
FIRST_WAIT_S: Final = 0.2
LONGEST_WAIT_S: Final = 20.0
GATHER_S: Final = 0.001
"""Time in which changes of residents are combined into one report."""
_T = TypeVar("_T")


class SimulatedWorker:
    """A machine with a daemon. ``dice`` draws its faults."""

    def __init__(
        self,
        machine: SimulatedMachine,
        world: SimulatedWorld,
        manager: SimulatedManager,
        dice: random.Random,
    ) -> None:
        self.machine = machine
        self._world = world
        self._scenario = world.setting.scenario
        self._queue = world.queue
        self._manager = manager
        self._dice = dice
        self._path = NetworkPath(world.queue, machine.latency_s)
        self._fetched: set[str] = set()
        self._life = 0
        self._misses = 0
        self._backoff = Backoff(FIRST_WAIT_S, LONGEST_WAIT_S, lambda: self._dice.uniform(0.8, 1.2))
        self._renewed_s = 0.0
        self._report_due = False
        self.slots: SimulatedSlots | None = None
        self._session: WorkerSession | None = None
        self._stream: Stream | None = None
        self._outbox: dict[LeaseRef, LeaseResult] = {}

    def boot(self) -> None:
        """Start the process and schedule its faults."""
        self._life += 1
        self._session, self._outbox = None, {}
        self.slots = SimulatedSlots(
            self.machine, self._world, self._dice, self._fetched, self._take_result, self._residents_changed
        )
        self._register()
        self._later_at_random(self._scenario.faults.death_rate, self._die)
        self._later_at_random(self._scenario.faults.partition_rate, self._lose_network)

    def kill(self, *, silent: bool) -> None:
        """End the process; another starts later. A ``silent`` death breaks no connection."""
        if self.slots is None:
            return
        self._world.report.counts["silent deaths" if silent else "deaths"] += 1
        self._world.report.died_s[self.machine.worker_id] = self._queue.now_s
        self._disconnect(silent=silent)
        self.slots.stop()
        self.slots = None
        self._life += 1
        self._queue.after(self._scenario.faults.respawn_s, self.boot)

    def cut(self, seconds: float, *, up: bool = True, down: bool = True) -> None:
        """Cut its network for ``seconds``."""
        self._world.report.counts["partitions"] += 1
        self._path.cut(seconds, up=up, down=down)

    def _die(self) -> None:
        self.kill(silent=self._dice.random() < self._scenario.faults.silent_deaths)

    def _lose_network(self) -> None:
        faults = self._scenario.faults
        fate = self._dice.random()
        half = fate < faults.half_open
        up = not half or fate < faults.half_open / 2
        self.cut(faults.partition_s, up=up, down=not half or not up)
        self._later(
            faults.partition_s, lambda: self._later_at_random(faults.partition_rate, self._lose_network)
        )

    def _later_at_random(self, rate: float, action: Callable[[], None]) -> None:
        if rate:
            self._later(self._dice.expovariate(rate), action)

    def _later(self, delay_s: float, action: Callable[[], None]) -> None:
        """Schedule an action that is dropped if the process ends before."""
        life = self._life

        def happen() -> None:
            if life == self._life:
                action()

        self._queue.after(delay_s, happen)

    def _register(self) -> None:
        boot_id = f"{self.machine.worker_id}.{self._life}"

        def welcome(session: WorkerSession) -> None:
            self._session = session
            self._attach()

        self._ask(
            lambda: self._manager.register(self.machine.worker_id, boot_id, self.machine.resources),
            welcome,
            REGISTER_S,
            self._wait,
        )

    def _attach(self) -> None:
        """Open a stream with the full state; register first if there is no session."""
        session, slots = self._session, self.slots
        if session is None or slots is None:
            self._register()
            return
        stream = self._stream = Stream(
            lambda message: self._path.down(lambda: self._read(stream, message)),
            lambda: self._path.down(lambda: self._superseded(stream)),
        )
        state = WorkerState(slots.residents(), slots.held(), tuple(self._outbox.values()))

        def greeted(_: None) -> None:
            self._misses = 0
            self._backoff.reset()
            self._renewed_s = self._queue.now_s
            self._later(self._scenario.liveness.heartbeat_s, lambda: self._beat(stream))

        self._ask(lambda: self._manager.attach(session, state, stream), greeted, ANSWER_S, self._reconnect)

    def _beat(self, stream: Stream) -> None:
        session, slots = self._session, self.slots
        if stream is not self._stream or session is None or slots is None:
            return
        held, progress = slots.held(), slots.progress()

        def renewed(interval_s: float) -> None:
            self._misses, self._renewed_s = 0, self._queue.now_s
            self._later(interval_s, lambda: self._beat(stream))

        def missed() -> None:
            self._misses += 1
            if self._misses >= MISSES:
                self._reconnect()
            else:
                self._beat(stream)

        self._ask(lambda: self._manager.heartbeat(session, held, progress), renewed, ANSWER_S, missed)

    def _ask(
        self, call: Callable[[], _T], answered: Callable[[_T], None], limit_s: float, late: Callable[[], None]
    ) -> None:
        """Call the manager; then call ``answered`` or, after ``limit_s``, ``late``, unless the session is over."""
        waiting = [True]

        def take(answer: _T) -> None:
            if waiting:
                waiting.clear()
                answered(answer)

        def give_up() -> None:
            if waiting:
                waiting.clear()
                late()

        def arrive() -> None:
            try:
                answer = call()
            except SupersededError:
                stream = self._stream
                self._path.down(lambda: self._superseded(stream))
            else:
                self._path.down(lambda: take(answer))

        self._path.up(lambda: self._manager.receive(arrive))
        self._later(limit_s, give_up)

    def _reconnect(self) -> None:
        self._disconnect(silent=False)
        self._wait()

    def _wait(self) -> None:
        """Reconnect with exponential backoff; drop leases that can no longer be renewed."""
        lapsed = self._queue.now_s - self._renewed_s > self._scenario.dispatch.lease_ttl_s
        if self.slots is not None and lapsed:
            self.slots.cancel(set(self.slots.held()))
        self._later(self._backoff.next_s(), self._attach)

    def _disconnect(self, *, silent: bool) -> None:
        session, stream = self._session, self._stream
        self._path.hang_up()
        self._stream = None
        if session is not None and stream is not None and not silent:
            self._path.up(lambda: self._manager.receive(lambda: self._manager.detach(session, stream)))

    def _superseded(self, stream: Stream | None) -> None:
        """End a session that the manager gave up: its leases are void."""
        if stream is not self._stream or self.slots is None:
            return
        self._world.report.counts["sessions given up"] += 1
        self.slots.cancel(set(self.slots.held()))
        self._disconnect(silent=True)
        self._session = None
        self._register()

    def _read(self, stream: Stream, message: OutgoingMessage) -> None:
        if stream is not self._stream or self.slots is None:
            return
        for ref in (*message.acknowledged, *message.cancelled):
            self._outbox.pop(ref, None)
        if message.cancelled:
            self.slots.cancel(set(message.cancelled))
        if message.desired is not None:
            self.slots.want(message.desired)
        for lease in message.leases:
            self.slots.submit(lease)

    def _take_result(self, result: LeaseResult) -> None:
        if isinstance(result.outcome, Completed):
            self._world.checker.executed(result.outcome.trace_digest, self.machine.worker_id)
        self._outbox[result.ref] = result
        self._send(None, (result,))

    def _residents_changed(self) -> None:
        if not self._report_due:
            self._report_due = True
            self._queue.after(GATHER_S, self._report_state)

    def _report_state(self) -> None:
        self._report_due = False
        if self.slots is not None:
            self._send(WorkerState(self.slots.residents(), self.slots.held()), ())

    def _send(self, state: WorkerState | None, results: tuple[LeaseResult, ...]) -> None:
        session, stream = self._session, self._stream
        if session is None or stream is None:
            return

        def arrive() -> None:
            try:
                self._manager.report(session, state, results)
            except SupersededError:
                self._path.down(lambda: self._superseded(stream))

        self._path.up(lambda: self._manager.receive(arrive, results=len(results)))
