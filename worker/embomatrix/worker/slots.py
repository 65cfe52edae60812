"""The worker's slots: leases wait for their scene and a free permit, run in a process, and end in one result."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import heapq
import itertools
import logging
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.values import (
    Completed,
    InfraCode,
    InfraFailure,
    LeaseClaim,
    LeaseProgress,
    LeaseResult,
    ResidentState,
)
from embomatrix.worker.execution import Shift, Ticket
from embomatrix.worker.processes import SIMULATOR_PROGRAM, ProcessGoneError
from embomatrix.worker.progress import ProgressBoard
from embomatrix.worker.residents import Residents

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable
    from pathlib import Path

    from embomatrix.rpc.values import Lease, LeaseRef, Resident
    from embomatrix.worker.residents import Scene, SlotLimits

logger = logging.getLogger(__name__)

RETRY_CHECK_S: Final = 1.0
AHEAD: Final = 2
"""Leases that wait behind each slot while others are asked for."""
OVERTAKEN_S: Final = 0.2
"""A lease that has waited for this long is not overtaken by one whose scene a slot has at hand."""


class SlotPool:
    """Executes leases. Each one that is submitted ends in exactly one result, unless it is cancelled.

    ``bundle_path`` brings a bundle to disk and raises LoadError when it can't; ``on_result`` takes the results;
    ``on_change`` is called when residents changed.
    """

    def __init__(
        self,
        limits: SlotLimits,
        *,
        bundle_path: Callable[[str], Awaitable[Path]],
        on_result: Callable[[LeaseResult], None],
        on_change: Callable[[], None],
        log: Path,
        program: tuple[str, ...] = SIMULATOR_PROGRAM,
    ) -> None:
        self._limits = limits
        self._on_result = on_result
        self._on_change = on_change
        self._board = ProgressBoard.create(limits.slots)
        self._residents = Residents(
            limits,
            bundle_path=bundle_path,
            on_change=self._scene_changed,
            log=log,
            program=program,
            board=self._board,
        )
        self._wanted: tuple[str, ...] = ()
        self._waiting: deque[Ticket] = deque()
        self._tickets: dict[LeaseRef, Ticket] = {}
        self._free = list(range(1, limits.slots + 1))
        """Permits that nobody has, as a heap: the lowest is given first, so that a little work stays on few."""
        self._at_work: dict[int, Shift] = {}
        """What each occupied permit executes."""
        self._tasks: asyncio.TaskGroup | None = None
        self._clock = 0
        self._resting = False
        self._wake = asyncio.Event()
        self._unsettled = False
        """A wanted scene is not warm, or too much is held: when a scene falls idle, more can be done about it."""

    @property
    def load(self) -> float:
        """Share of the slots that execute something, 0 to 1."""
        return 1.0 - len(self._free) / self._limits.slots

    @property
    def ahead(self) -> bool:
        """Whether every slot executes something, and enough waits behind it until more can come."""
        return not self._free and len(self._tickets) >= (1 + AHEAD) * self._limits.slots

    @property
    def memory_used_mb(self) -> float:
        return self._residents.memory_used_mb

    def residents(self) -> tuple[Resident, ...]:
        return self._residents.report()

    def held(self) -> tuple[LeaseRef, ...]:
        """Leases that wait or run here: those to renew."""
        return tuple(self._tickets)

    def progress(self) -> tuple[LeaseProgress, ...]:
        """How far the leases are that run."""
        running = ((shift.given[0], permit) for permit, shift in self._at_work.items() if shift.given)
        return tuple(
            LeaseProgress(ticket.lease.ref, self._board.steps(permit))
            for ticket, permit in running
            if not ticket.called_off
        )

    def claims(self) -> tuple[LeaseClaim, ...]:
        """What these leases are for."""
        leases = (ticket.lease for ticket in self._tickets.values())
        return tuple(LeaseClaim(lease.ref, lease.origin) for lease in leases if lease.origin is not None)

    def want(self, digests: Iterable[str]) -> None:
        """Replace the scenes that should be resident, the most urgent first."""
        self._wanted = tuple(dict.fromkeys(digests))
        self._wake.set()

    def submit(self, lease: Lease) -> None:
        """Execute this lease when a slot is free and its scene is warm. One that is held already is left alone."""
        if lease.ref in self._tickets:
            return
        digest = lease.rollout.bundle_digest
        warm = self._residents.warm(digest) is not None
        ticket = Ticket(lease, time.monotonic(), warm)
        self._residents.retry(digest)
        self._tickets[lease.ref] = ticket
        self._waiting.append(ticket)
        if warm:
            self._start_leases()
        else:
            self._wake.set()

    def cancel(self, refs: Iterable[LeaseRef]) -> None:
        """Forget these leases; what runs is killed, and none of them gives a result."""
        for ref in refs:
            ticket = self._tickets.pop(ref, None)
            if ticket is None:
                continue
            shift = self._at_work.get(ticket.slot)
            if shift is None:
                self._waiting.remove(ticket)
            else:
                shift.call_off(ticket)
        self._wake.set()

    def rest(self) -> None:
        """Begin nothing from now on, neither leases nor loading; what slots were given goes on, and scenes stay."""
        self._resting = True

    def go_on(self) -> None:
        """Take a rest back."""
        self._resting = False
        self._start_leases()
        self._wake.set()

    def shed(self) -> None:
        """Give up the scenes in which nothing runs, for the memory that they hold."""
        self._residents.shed()

    async def start(self) -> None:
        """Start the simulator. Raises ProcessGoneError with the reason when that can't be."""
        await self._residents.start()

    async def run(self) -> None:
        """Load, evict and execute until cancelled; then every process is ended."""
        try:
            async with asyncio.TaskGroup() as self._tasks:
                await self._work(self._tasks)
        finally:
            await self._residents.close()

    async def _work(self, tasks: asyncio.TaskGroup) -> None:
        try:
            while True:
                await self._wait_for_work()
                self._settle(tasks)
                self._start_leases()
        finally:
            self._tasks = None

    async def _wait_for_work(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(RETRY_CHECK_S if self._residents.failed() else None):
                await self._wake.wait()
        self._wake.clear()

    def _settle(self, tasks: asyncio.TaskGroup) -> None:
        if self._resting:
            return
        # Scenes of leases that wait come before those that are only announced.
        wanted = tuple(dict.fromkeys((*(ticket.digest for ticket in self._waiting), *self._wanted)))
        self._residents.settle(wanted, tasks)
        over = self._residents.memory_used_mb > self._limits.memory_mb
        self._unsettled = over or any(self._residents.warm(digest) is None for digest in wanted)

    def _scene_changed(self, scene: Scene) -> None:
        if scene.state is ResidentState.FAILED:
            for ticket in [ticket for ticket in self._waiting if ticket.digest == scene.digest]:
                self._waiting.remove(ticket)
                self._finish(ticket, InfraFailure(scene.code, f"scene {scene.digest}: {scene.error}"))
        self._on_change()
        self._wake.set()

    def _start_leases(self) -> None:
        """Occupy free permits as long as a lease waits whose scene is warm."""
        while self._tasks is not None and self._free and (found := self._next_lease()) is not None:
            permit = heapq.heappop(self._free)
            shift = self._occupy(permit, *found)
            shift.task = self._tasks.create_task(self._serve(shift))
            # A task that is cancelled before its first step runs no `finally` of its own.
            shift.task.add_done_callback(functools.partial(self._vacate, permit))

    def _next_lease(self) -> tuple[Ticket, Scene] | None:
        if self._resting:
            return None
        for ticket in self._waiting:
            scene = self._residents.warm(ticket.digest)
            if scene is not None:
                self._waiting.remove(ticket)
                return ticket, scene
        return None

    def _more(self, scene: Scene, count: int) -> list[Ticket]:
        """Leases of this scene that wait, up to a count: no more than a slot's share of all that wait.

        They may overtake those of other scenes, until one of these has waited for long.
        """
        count = min(count, len(self._waiting) // self._limits.slots)
        if count <= 0 or self._resting or self._residents.warm(scene.digest) is not scene:
            return []
        late = time.monotonic() - self._waiting[0].taken_s > OVERTAKEN_S
        fits = functools.partial(Ticket.fits, digest=scene.digest)
        found = itertools.takewhile(fits, self._waiting) if late else filter(fits, self._waiting)
        tickets = list(itertools.islice(found, count))
        for ticket in tickets:
            self._waiting.remove(ticket)
        return tickets

    def _occupy(self, permit: int, ticket: Ticket, scene: Scene) -> Shift:
        self._clock += 1
        scene.last_used = self._clock
        scene.running += 1
        self._board.set(permit, 0)
        shift = self._at_work[permit] = Shift(permit, scene)
        shift.give(ticket)
        return shift

    def _leave(self, permit: int) -> None:
        """The shift is over; what was not begun in it waits again, in front."""
        shift = self._at_work.pop(permit)
        for ticket in reversed(shift.given):
            if not ticket.called_off:
                ticket.slot = 0
                self._waiting.appendleft(ticket)
        self._residents.release(shift.scene)
        if self._unsettled and not shift.scene.running:
            self._wake.set()

    def _vacate(self, permit: int, _: asyncio.Task[None]) -> None:
        if permit in self._at_work:
            self._leave(permit)
        heapq.heappush(self._free, permit)
        self._start_leases()

    async def _serve(self, shift: Shift) -> None:
        """Work this shift off, and under the same permit the leases that wait behind it."""
        permit, task = shift.permit, shift.task
        while True:
            await self._work_off(shift)
            self._leave(permit)
            found = self._next_lease()
            if found is None:
                return
            shift = self._occupy(permit, *found)
            shift.task = task

    async def _work_off(self, shift: Shift) -> None:
        def more(count: int) -> list[Ticket]:
            tickets = self._more(shift.scene, count)
            for ticket in tickets:
                shift.give(ticket)
            return tickets

        try:
            slot = await shift.scene.take_slot(self._limits.fork_s)
        except ProcessGoneError as error:
            self._scene_died(shift, str(error))
            return
        try:
            await shift.work(slot, self._residents, more=more, done=self._finish)
        except Exception as error:
            if not shift.given:
                raise
            ticket = shift.given.popleft()
            logger.exception("defect while executing lease=%s", ticket.lease.ref.lease_id)
            defect = f"{type(error).__name__}: {error}"[:500]
            self._finish(ticket, InfraFailure(InfraCode.SLOT_CRASHED, defect))

    def _scene_died(self, shift: Shift, reason: str) -> None:
        """Have the scene loaded anew for this lease, once."""
        self._residents.lost(shift.scene, reason)
        ticket = shift.given[0]
        if ticket.requeued:
            shift.given.popleft()
            died = "the scene's process died twice before the rollout began"
            self._finish(ticket, InfraFailure(InfraCode.SLOT_CRASHED, died))
        ticket.requeued, ticket.found_warm = True, False

    def _finish(self, ticket: Ticket, outcome: Completed | InfraFailure) -> None:
        lease = ticket.lease
        if self._tickets.get(lease.ref) is not ticket:
            return
        del self._tickets[lease.ref]
        held_s = time.monotonic() - ticket.turn_s if ticket.slot else 0.0
        if isinstance(outcome, Completed):
            # Of answers that came together, all but the first seem to have taken no time.
            held_s = max(held_s, outcome.timings.execute_s)
        self._on_result(LeaseResult(lease.ref, outcome, lease.origin, ticket.slot, held_s))
