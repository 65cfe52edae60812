"""A simulated worker daemon: joins, keeps its session, gives its results until they are acknowledged, and dies when it must."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from embomatrix.host.backoff import Backoff
from embomatrix.manager.simulation.front import Stream
from embomatrix.manager.simulation.line import Line
from embomatrix.manager.simulation.slots import SimulatedSlots, SlotEnvironment
from embomatrix.rpc.status import SupersededError
from embomatrix.rpc.wire.leases import WorkerState
from embomatrix.rpc.wire.values import Completed

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    from embomatrix.manager.runtime.registry import WorkerSession
    from embomatrix.manager.simulation.agenda import Agenda
    from embomatrix.manager.simulation.auditor import InvariantChecker
    from embomatrix.manager.simulation.front import Letter, SimulatedManager
    from embomatrix.manager.simulation.gauge import Gauge
    from embomatrix.manager.simulation.machines import Setting, SimulatedMachine
    from embomatrix.manager.simulation.scenario import SimulationScenario
    from embomatrix.rpc.wire.leases import LeaseRef, LeaseResult

ANSWER_S: Final = 2.0
"""A heartbeat or a new stream without an answer for this long is given up."""
REGISTER_S: Final = 10.0
MISSES: Final = 3
FIRST_WAIT_S: Final = 0.2
LONGEST_WAIT_S: Final = 20.0
GATHER_S: Final = 0.001
"""Changes of residents are gathered for this long into one report."""
_T = TypeVar("_T")


class SimulatedWorker:
    """A machine with a daemon on it. ``dice`` decide about its faults."""

    def __init__(
        self,
        machine: SimulatedMachine,
        scenario: SimulationScenario,
        setting: Setting,
        agenda: Agenda,
        front: SimulatedManager,
        auditor: InvariantChecker,
        gauge: Gauge,
        dice: random.Random,
    ) -> None:
        self.machine = machine
        self._scenario = scenario
        self._agenda = agenda
        self._front = front
        self._auditor = auditor
        self._gauge = gauge
        self._dice = dice
        self._line = Line(agenda, machine.latency_s)
        self._around = SlotEnvironment(
            agenda, setting, scenario.faults, dice, gauge, self._take_result, self._residents_changed
        )
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
        """The process starts, and what will happen to it is drawn."""
        self._life += 1
        self._session, self._outbox = None, {}
        self.slots = SimulatedSlots(self.machine, self._around, self._fetched)
        self._register()
        self._later_at_random(self._scenario.faults.death_rate, self._die)
        self._later_at_random(self._scenario.faults.partition_rate, self._lose_network)

    def kill(self, *, silent: bool) -> None:
        """The process ends, and another starts later. A silent death breaks no connection: nobody is told."""
        if self.slots is None:
            return
        self._gauge.counts["silent deaths" if silent else "deaths"] += 1
        self._gauge.died_s[self.machine.worker_id] = self._agenda.now_s
        self._hang_up(silent=silent)
        self.slots.stop()
        self.slots = None
        self._life += 1
        self._agenda.after(self._scenario.faults.respawn_s, self.boot)

    def cut(self, seconds: float, *, up: bool = True, down: bool = True) -> None:
        """Its network is gone for so long, both ways or one."""
        self._gauge.counts["partitions"] += 1
        self._line.cut(seconds, up=up, down=down)

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
        """Have it happen to this life of the worker, not to a later one."""
        life = self._life

        def happen() -> None:
            if life == self._life:
                action()

        self._agenda.after(delay_s, happen)

    # The connection

    def _register(self) -> None:
        boot_id = f"{self.machine.worker_id}.{self._life}"

        def welcome(session: WorkerSession) -> None:
            self._session = session
            self._attach()

        self._ask(
            lambda: self._front.register(self.machine.worker_id, boot_id, self.machine.resources),
            welcome,
            REGISTER_S,
            self._wait,
        )

    def _attach(self) -> None:
        """Open a stream with the full state."""
        session, slots = self._session, self.slots
        if session is None or slots is None:
            self._register()
            return
        stream = self._stream = Stream(
            lambda letter: self._line.down(lambda: self._read(stream, letter)),
            lambda: self._line.down(lambda: self._superseded(stream)),
        )
        state = WorkerState(slots.residents(), slots.held(), tuple(self._outbox.values()))

        def greeted(_: None) -> None:
            self._misses = 0
            self._backoff.reset()
            self._renewed_s = self._agenda.now_s
            self._later(self._scenario.liveness.heartbeat_s, lambda: self._beat(stream))

        self._ask(lambda: self._front.attach(session, state, stream), greeted, ANSWER_S, self._reconnect)

    def _beat(self, stream: Stream) -> None:
        session, slots = self._session, self.slots
        if stream is not self._stream or session is None or slots is None:
            return
        held, progress = slots.held(), slots.progress()

        def renewed(interval_s: float) -> None:
            self._misses, self._renewed_s = 0, self._agenda.now_s
            self._later(interval_s, lambda: self._beat(stream))

        def missed() -> None:
            self._misses += 1
            if self._misses >= MISSES:
                self._reconnect()
            else:
                self._beat(stream)

        self._ask(lambda: self._front.heartbeat(session, held, progress), renewed, ANSWER_S, missed)

    def _ask(
        self, call: Callable[[], _T], answered: Callable[[_T], None], limit_s: float, late: Callable[[], None]
    ) -> None:
        """Call the manager; exactly one of the two hears of it, unless the session is over."""
        waiting = [True]

        def take(answer: _T) -> None:
            if waiting.pop() if waiting else False:
                answered(answer)

        def give_up() -> None:
            if waiting.pop() if waiting else False:
                late()

        def arrive() -> None:
            try:
                answer = call()
            except SupersededError:
                stream = self._stream
                self._line.down(lambda: self._superseded(stream))
            else:
                self._line.down(lambda: take(answer))

        self._line.up(lambda: self._front.hear(arrive))
        self._later(limit_s, give_up)

    def _reconnect(self) -> None:
        self._hang_up(silent=False)
        self._wait()

    def _wait(self) -> None:
        """Try again later, longer each time; what can't be renewed meanwhile is stopped."""
        self._fence()
        self._later(self._backoff.next_s(), self._attach)

    def _fence(self) -> None:
        if (
            self.slots is not None
            and self._agenda.now_s - self._renewed_s > self._scenario.dispatch.lease_ttl_s
        ):
            self.slots.cancel(set(self.slots.held()))

    def _hang_up(self, *, silent: bool) -> None:
        session, stream = self._session, self._stream
        self._line.hang_up()
        self._stream = None
        if session is not None and stream is not None and not silent:
            self._line.up(lambda: self._front.hear(lambda: self._front.detach(session, stream)))

    def _superseded(self, stream: Stream | None) -> None:
        """The manager gave this session up: what it leased is void."""
        if stream is not self._stream or self.slots is None:
            return
        self._gauge.counts["sessions given up"] += 1
        self.slots.cancel(set(self.slots.held()))
        self._hang_up(silent=True)
        self._session = None
        self._register()

    # What is said on the stream

    def _read(self, stream: Stream, letter: Letter) -> None:
        if stream is not self._stream or self.slots is None:
            return
        for ref in (*letter.ended, *letter.cancelled):
            self._outbox.pop(ref, None)
        if letter.cancelled:
            self.slots.cancel(set(letter.cancelled))
        if letter.desired is not None:
            self.slots.want(letter.desired)
        for lease in letter.leases:
            self.slots.submit(lease)

    def _take_result(self, result: LeaseResult) -> None:
        if isinstance(result.outcome, Completed):
            self._auditor.executed(result.outcome.trace_digest, self.machine.worker_id)
        self._outbox[result.ref] = result
        self._say(None, (result,))

    def _residents_changed(self) -> None:
        if not self._report_due:
            self._report_due = True
            self._agenda.after(GATHER_S, self._tell_state)

    def _tell_state(self) -> None:
        self._report_due = False
        if self.slots is not None:
            self._say(WorkerState(self.slots.residents(), self.slots.held()), ())

    def _say(self, state: WorkerState | None, results: tuple[LeaseResult, ...]) -> None:
        session, stream = self._session, self._stream
        if session is None or stream is None:
            return

        def arrive() -> None:
            try:
                self._front.report(session, state, results)
            except SupersededError:
                self._line.down(lambda: self._superseded(stream))

        self._line.up(lambda: self._front.hear(arrive, results=len(results)))
