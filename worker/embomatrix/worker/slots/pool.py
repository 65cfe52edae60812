"""The worker's slots: leases wait for their scene and a free permit, run in a process, and end in one result."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import heapq
import logging
import time
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.wire.leases import LeaseClaim, LeaseProgress, LeaseResult
from embomatrix.rpc.wire.values import (
    Completed,
    InfraCode,
    InfraFailure,
    ResidentState,
)
from embomatrix.worker.slots.execution import Shift, Ticket
from embomatrix.worker.slots.processes import SIMULATOR_PROGRAM, ProcessGoneError
from embomatrix.worker.slots.progress import ProgressBoard
from embomatrix.worker.slots.residents import Residents
from embomatrix.worker.slots.waiting import WaitingLeases

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable
    from pathlib import Path

    from embomatrix.rpc.wire.leases import Lease, LeaseRef
    from embomatrix.rpc.wire.values import Resident
    from embomatrix.worker.slots.residents import ResidentScene, SlotLimits

logger = logging.getLogger(__name__)

RETRY_CHECK_S: Final = 1.0
AHEAD: Final = 2
"""Leases that wait behind each slot while others are asked for."""


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
        self._budget_mb = limits.memory_mb
        """What scenes may hold now: the limit, or less while memory is scarce."""
        self._wanted: tuple[str, ...] = ()
        self._waiting = WaitingLeases(limits.slots, self._residents.warm)
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
        self._waiting.add(ticket)
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

    def allow(self, memory_mb: float) -> None:
        """Scenes may hold so much from now on, and what the limits say at most: what is more is evicted, the most urgent
        one excepted, and what then fits is loaded."""
        before, self._budget_mb = self._budget_mb, min(memory_mb, self._limits.memory_mb)
        over = self._residents.memory_used_mb > self._budget_mb
        if over and self._residents.memory_used_mb <= before:
            logger.info("memory is scarce: scenes may hold %d MB now", self._budget_mb)
        if over or self._unsettled:
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
        self._residents.settle(wanted, tasks, budget_mb=self._budget_mb)
        over = self._residents.memory_used_mb > self._budget_mb
        self._unsettled = over or any(self._residents.warm(digest) is None for digest in wanted)

    def _scene_changed(self, scene: ResidentScene) -> None:
        if scene.state is ResidentState.FAILED:
            for ticket in self._waiting.take_of(scene.digest):
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

    def _next_lease(self) -> tuple[Ticket, ResidentScene] | None:
        return None if self._resting else self._waiting.take(time.monotonic())

    def _more_for(self, shift: Shift, count: int) -> list[Ticket]:
        tickets = [] if self._resting else self._waiting.take_more(shift.scene, count, time.monotonic())
        for ticket in tickets:
            shift.give(ticket)
        return tickets

    def _occupy(self, permit: int, ticket: Ticket, scene: ResidentScene) -> Shift:
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
        unbegun = [ticket for ticket in shift.given if not ticket.called_off]
        for ticket in unbegun:
            ticket.slot = 0
        self._waiting.give_back(unbegun)
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
        try:
            slot = await shift.scene.take_slot(self._limits.fork_s)
        except ProcessGoneError as error:
            self._scene_died(shift, str(error))
            return
        try:
            more = functools.partial(self._more_for, shift)
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
        if isinstance(outcome, Completed):
            # What the slot says: of answers that are read together the first would be given the time of all.
            held_s = outcome.timings.execute_s
        else:
            held_s = time.monotonic() - ticket.turn_s if ticket.slot else 0.0
        self._on_result(LeaseResult(lease.ref, outcome, lease.origin, ticket.slot, held_s))
