"""The worker's slots: leases wait for their scene and a free permit, run in a process, and end in one result."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import heapq
import logging
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.values import (
    InfraCode,
    InfraFailure,
    LeaseClaim,
    LeaseProgress,
    LeaseResult,
    ResidentState,
)
from embomatrix.worker.execution import Ticket, execute
from embomatrix.worker.processes import SIMULATOR_PROGRAM, ProcessGoneError
from embomatrix.worker.progress import ProgressBoard
from embomatrix.worker.residents import Residents

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable
    from pathlib import Path

    from embomatrix.rpc.values import Completed, Lease, LeaseRef, Resident
    from embomatrix.worker.residents import Scene, SlotLimits

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
        self._wanted: tuple[str, ...] = ()
        self._waiting: deque[Ticket] = deque()
        self._tickets: dict[LeaseRef, Ticket] = {}
        self._free = list(range(1, limits.slots + 1))
        """Permits that nobody has, as a heap: the lowest is given first, so that a little work stays on few."""
        self._at_work: dict[int, Scene] = {}
        """The scene that each occupied permit executes in."""
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
        return not self._free and len(self._waiting) >= AHEAD * self._limits.slots

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
        running = ((ref, ticket.slot) for ref, ticket in self._tickets.items() if ticket.slot)
        return tuple(LeaseProgress(ref, self._board.steps(slot)) for ref, slot in running)

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
            if ticket.task is None:
                self._waiting.remove(ticket)
            else:
                ticket.task.cancel()
        self._wake.set()

    def rest(self) -> None:
        """Begin nothing from now on, neither leases nor loading; what runs goes on, and scenes stay."""
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
            ticket, scene = found
            slot = heapq.heappop(self._free)
            self._occupy(slot, ticket, scene)
            ticket.task = self._tasks.create_task(self._serve(slot, ticket, scene))
            # A task that is cancelled before its first step runs no `finally` of its own.
            ticket.task.add_done_callback(functools.partial(self._vacate, slot))

    def _next_lease(self) -> tuple[Ticket, Scene] | None:
        if self._resting:
            return None
        for ticket in self._waiting:
            scene = self._residents.warm(ticket.digest)
            if scene is not None:
                self._waiting.remove(ticket)
                return ticket, scene
        return None

    def _occupy(self, slot: int, ticket: Ticket, scene: Scene) -> None:
        self._clock += 1
        scene.last_used = self._clock
        scene.running += 1
        ticket.slot, ticket.began_s = slot, time.monotonic()
        self._board.set(slot, 0)
        self._at_work[slot] = scene

    def _leave(self, slot: int) -> None:
        scene = self._at_work.pop(slot)
        self._residents.release(scene)
        if self._unsettled and not scene.running:
            self._wake.set()

    def _vacate(self, slot: int, _: asyncio.Task[None]) -> None:
        if slot in self._at_work:
            self._leave(slot)
        heapq.heappush(self._free, slot)
        self._start_leases()

    async def _serve(self, slot: int, ticket: Ticket, scene: Scene) -> None:
        """Execute this lease, and under the same permit those that wait behind it."""
        task = ticket.task
        while True:
            await self._run_lease(ticket, scene)
            self._leave(slot)
            found = self._next_lease()
            if found is None:
                return
            ticket, scene = found
            self._occupy(slot, ticket, scene)
            ticket.task = task

    async def _run_lease(self, ticket: Ticket, scene: Scene) -> None:
        outcome: Completed | InfraFailure | None
        try:
            outcome = await self._execute(ticket, scene)
        except Exception as error:
            logger.exception("defect while executing lease=%s", ticket.lease.ref.lease_id)
            outcome = InfraFailure(InfraCode.SLOT_CRASHED, f"{type(error).__name__}: {error}"[:500])
        if outcome is not None:
            self._finish(ticket, outcome)

    async def _execute(self, ticket: Ticket, scene: Scene) -> Completed | InfraFailure | None:
        """Run the rollout in a slot of its scene; None when the scene had died and the lease waits again."""
        try:
            slot = await scene.take_slot(self._limits.fork_s)
        except ProcessGoneError as error:
            return self._scene_died(ticket, scene, str(error))
        return await execute(ticket, scene, slot, self._residents)

    def _scene_died(self, ticket: Ticket, scene: Scene, reason: str) -> InfraFailure | None:
        """Have the scene loaded anew for this lease, once."""
        self._residents.lost(scene, reason)
        if ticket.requeued:
            return InfraFailure(
                InfraCode.SLOT_CRASHED, "the scene's process died twice before the rollout began"
            )
        ticket.requeued, ticket.found_warm, ticket.task, ticket.slot = True, False, None, 0
        self._waiting.appendleft(ticket)
        return None

    def _finish(self, ticket: Ticket, outcome: Completed | InfraFailure) -> None:
        if self._tickets.pop(ticket.lease.ref, None) is not None:
            held_s = time.monotonic() - ticket.began_s if ticket.slot else 0.0
            self._on_result(LeaseResult(ticket.lease.ref, outcome, ticket.lease.origin, ticket.slot, held_s))
