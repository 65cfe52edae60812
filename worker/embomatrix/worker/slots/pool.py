"""Slot pool of a worker: leases wait for their scene and a permit, run in a process, and end in one result."""

import asyncio
import contextlib
import functools
import heapq
import logging
import time
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path
from typing import Final

from embomatrix.rpc.wire.leases import Lease, LeaseClaim, LeaseProgress, LeaseRef, LeaseResult
from embomatrix.rpc.wire.values import Completed, InfraCode, InfraFailure, Resident, ResidentState
from embomatrix.worker.slots.execution import HeldLease, SlotRun
from embomatrix.worker.slots.processes import SIMULATOR_PROGRAM, ProcessGoneError
from embomatrix.worker.slots.residents import Residents, ResidentScene, SlotLimits
from embomatrix.worker.slots.slot_program import ProgressBoard
from embomatrix.worker.slots.waiting import WaitingLeases

logger = logging.getLogger(__name__)

RETRY_CHECK_S: Final = 1.0
AHEAD: Final = 2
"""Leases that wait behind each slot while more are requested."""


class SlotPool:
    """Executes leases. Each submitted lease ends in exactly one result, unless it is cancelled.

    ``bundle_path`` returns a bundle's file, or raises LoadError; ``on_result`` gets the results; ``on_change`` is called after
    residents changed.
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
        """Memory of all scenes: the limit, or less while memory is scarce."""
        self._wanted: tuple[str, ...] = ()
        self._waiting = WaitingLeases(limits.slots, self._residents.warm)
        self._leases: dict[LeaseRef, HeldLease] = {}
        self._free = list(range(1, limits.slots + 1))
        """Free permits as a heap: the lowest is given first, so that a little work stays on few slots."""
        self._runs: dict[int, SlotRun] = {}
        """Runs by occupied permit."""
        self._tasks: asyncio.TaskGroup | None = None
        self._clock = 0
        self._paused = False
        self._wake = asyncio.Event()
        self._unsettled = False
        """True if a wanted scene is not warm or too much memory is held: the next idle scene may help."""

    @property
    def load(self) -> float:
        """Share of busy slots, 0 to 1."""
        return 1.0 - len(self._free) / self._limits.slots

    @property
    def is_saturated(self) -> bool:
        """True if every slot is busy and enough leases wait until more can come."""
        return not self._free and len(self._leases) >= (1 + AHEAD) * self._limits.slots

    @property
    def memory_used_mb(self) -> float:
        return self._residents.memory_used_mb

    def residents(self) -> tuple[Resident, ...]:
        return self._residents.report()

    def held(self) -> tuple[LeaseRef, ...]:
        """Leases that wait or run here, to be renewed."""
        return tuple(self._leases)

    def progress(self) -> tuple[LeaseProgress, ...]:
        """Progress of the running leases."""
        running = ((run.queue[0], permit) for permit, run in self._runs.items() if run.queue)
        return tuple(
            LeaseProgress(held.lease.ref, self._board.steps(permit))
            for held, permit in running
            if not held.cancelled
        )

    def claims(self) -> tuple[LeaseClaim, ...]:
        """Origins of the held leases."""
        leases = (held.lease for held in self._leases.values())
        return tuple(LeaseClaim(lease.ref, lease.origin) for lease in leases if lease.origin is not None)

    def want(self, digests: Iterable[str]) -> None:
        """Replace the list of scenes that should be resident, the most urgent first."""
        self._wanted = tuple(dict.fromkeys(digests))
        self._wake.set()

    def submit(self, lease: Lease) -> None:
        """Execute this lease once a slot is free and its scene is warm. A lease that is held already is ignored."""
        if lease.ref in self._leases:
            return
        digest = lease.rollout.bundle_digest
        warm = self._residents.warm(digest) is not None
        held = HeldLease(lease, time.monotonic(), warm)
        self._residents.retry(digest)
        self._leases[lease.ref] = held
        self._waiting.add(held)
        if warm:
            self._start_leases()
        else:
            self._wake.set()

    def cancel(self, refs: Iterable[LeaseRef]) -> None:
        """Drop these leases without results; running ones are killed."""
        for ref in refs:
            held = self._leases.pop(ref, None)
            if held is None:
                continue
            run = self._runs.get(held.slot)
            if run is None:
                self._waiting.remove(held)
            else:
                run.cancel(held)
        self._wake.set()

    def pause(self) -> None:
        """Begin no more leases and no more loading. Running leases continue, and scenes stay."""
        self._paused = True

    def resume(self) -> None:
        """End a pause."""
        self._paused = False
        self._start_leases()
        self._wake.set()

    def limit_memory(self, memory_mb: float) -> None:
        """Set the memory of all scenes, up to the configured limit.

        Scenes beyond it are evicted except the most urgent one; wanted scenes that fit are loaded.
        """
        before, self._budget_mb = self._budget_mb, min(memory_mb, self._limits.memory_mb)
        over = self._residents.memory_used_mb > self._budget_mb
        if over and self._residents.memory_used_mb <= before:
            logger.info("memory is scarce: scenes may hold %d MB", self._budget_mb)
        if over or self._unsettled:
            self._wake.set()

    def shed(self) -> None:
        """Evict the scenes in which nothing runs, to free their memory."""
        self._residents.shed()

    async def start(self) -> None:
        """Start the simulator. Raise ProcessGoneError with the reason if it does not start."""
        await self._residents.start()

    async def run(self) -> None:
        """Load, evict and execute until cancelled; then end every process."""
        try:
            async with asyncio.TaskGroup() as self._tasks:
                await self._schedule(self._tasks)
        finally:
            await self._residents.close()

    async def _schedule(self, tasks: asyncio.TaskGroup) -> None:
        try:
            while True:
                await self._wait_for_work()
                self._update_residents(tasks)
                self._start_leases()
        finally:
            self._tasks = None

    async def _wait_for_work(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(RETRY_CHECK_S if self._residents.failed() else None):
                await self._wake.wait()
        self._wake.clear()

    def _update_residents(self, tasks: asyncio.TaskGroup) -> None:
        if self._paused:
            return
        # Scenes of waiting leases come before scenes that are only announced.
        wanted = tuple(dict.fromkeys((*(held.digest for held in self._waiting), *self._wanted)))
        self._residents.update(wanted, tasks, budget_mb=self._budget_mb)
        over = self._residents.memory_used_mb > self._budget_mb
        self._unsettled = over or any(self._residents.warm(digest) is None for digest in wanted)

    def _scene_changed(self, scene: ResidentScene) -> None:
        if scene.state is ResidentState.FAILED:
            for held in self._waiting.take_of(scene.digest):
                self._finish(held, InfraFailure(scene.code, f"scene {scene.digest}: {scene.error}"))
        self._on_change()
        self._wake.set()

    def _start_leases(self) -> None:
        """Occupy free permits while a lease of a warm scene waits."""
        while self._tasks is not None and self._free and (found := self._next_lease()) is not None:
            permit = heapq.heappop(self._free)
            run = self._occupy(permit, *found)
            run.task = self._tasks.create_task(self._serve(run))
            # A task that is cancelled before its first step never reaches its own `finally`.
            run.task.add_done_callback(functools.partial(self._free_permit, permit))

    def _next_lease(self) -> tuple[HeldLease, ResidentScene] | None:
        return None if self._paused else self._waiting.take(time.monotonic())

    def _add_leases(self, run: SlotRun, count: int) -> list[HeldLease]:
        leases = [] if self._paused else self._waiting.take_more(run.scene, count, time.monotonic())
        for held in leases:
            run.add(held)
        return leases

    def _occupy(self, permit: int, held: HeldLease, scene: ResidentScene) -> SlotRun:
        self._clock += 1
        scene.last_used = self._clock
        scene.running += 1
        self._board.set(permit, 0)
        run = self._runs[permit] = SlotRun(permit, scene)
        run.add(held)
        return run

    def _end_run(self, permit: int) -> None:
        """End a run; its leases that were not begun wait again, in front."""
        run = self._runs.pop(permit)
        unbegun = [held for held in run.queue if not held.cancelled]
        for held in unbegun:
            held.slot = 0
        self._waiting.put_back(unbegun)
        self._residents.release(run.scene)
        if self._unsettled and not run.scene.running:
            self._wake.set()

    def _free_permit(self, permit: int, _: asyncio.Task[None]) -> None:
        if permit in self._runs:
            self._end_run(permit)
        heapq.heappush(self._free, permit)
        self._start_leases()

    async def _serve(self, run: SlotRun) -> None:
        """Execute this run and, under the same permit, runs of the leases that wait."""
        permit, task = run.permit, run.task
        while True:
            await self._execute(run)
            self._end_run(permit)
            found = self._next_lease()
            if found is None:
                return
            run = self._occupy(permit, *found)
            run.task = task

    async def _execute(self, run: SlotRun) -> None:
        try:
            slot = await run.scene.take_slot(self._limits.fork_s)
        except ProcessGoneError as error:
            self._scene_died(run, str(error))
            return
        try:
            more = functools.partial(self._add_leases, run)
            await run.execute(slot, self._residents, more=more, finish=self._finish)
        except Exception as error:
            if not run.queue:
                raise
            held = run.queue.popleft()
            logger.exception("defect while executing lease=%s", held.lease.ref.lease_id)
            defect = f"{type(error).__name__}: {error}"[:500]
            self._finish(held, InfraFailure(InfraCode.SLOT_CRASHED, defect))

    def _scene_died(self, run: SlotRun, reason: str) -> None:
        """Load the scene again for the first lease, once."""
        self._residents.lost(run.scene, reason)
        held = run.queue[0]
        if held.requeued:
            run.queue.popleft()
            died = "the scene's process died twice before the rollout began"
            self._finish(held, InfraFailure(InfraCode.SLOT_CRASHED, died))
        held.requeued, held.found_warm = True, False

    def _finish(self, held: HeldLease, outcome: Completed | InfraFailure) -> None:
        lease = held.lease
        if self._leases.get(lease.ref) is not held:
            return
        del self._leases[lease.ref]
        if isinstance(outcome, Completed):
            # The slot's own time: of answers that are read together, the first would count the time of all.
            held_s = outcome.timings.execute_s
        else:
            held_s = time.monotonic() - held.first_since_s if held.slot else 0.0
        self._on_result(
            LeaseResult(lease.ref, outcome, lease.origin, held.slot, held_s, lease.rollout.is_turn)
        )
