"""Resident scenes of a worker: fetched, loaded into dedicated processes, evicted if memory is short."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.wire.bounds import SENTENCE
from embomatrix.rpc.wire.values import InfraCode, Resident, ResidentState
from embomatrix.sim.zygote import PipeMessage
from embomatrix.worker.slots.processes import (
    FORK_S,
    SIMULATOR_PROGRAM,
    Child,
    ProcessGoneError,
    Root,
    start_root,
)
from embomatrix.worker.slots.residency import HeldScene, decide, surplus

if TYPE_CHECKING:
    from embomatrix.worker.slots.slot_program import ProgressBoard

logger = logging.getLogger(__name__)

SMALLEST_LIMIT_MB: Final = 512
"""A scene may map this much memory while it loads, or what the worker offers to all scenes if that is more."""
COLLECT_S: Final = 0.05
"""Time for the system to tear down a killed process before its parent collects it."""
LOAD_S: Final = 60.0
"""Limit for fetching and loading one scene."""
RETRY_LOAD_S: Final = 5.0
"""Interval between attempts to load a failing scene that is still wanted."""
KNOWN_SCENES: Final = 8_192
"""Scenes whose memory is remembered after they were evicted."""
SLOT_MB: Final = 8.0
IDLE_MEMORY_SHARE: Final = 0.25
"""Share of the worker's memory for idle processes of about 8 MB each. Scenes return step after step, and a kept process saves a
fork and its page faults."""


class LoadError(Exception):
    """Scene that can't be loaded, with the reason as a code for the manager."""

    def __init__(self, code: InfraCode, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True)
class SlotLimits:
    """Limits of a worker. ``memory_mb`` is for all residents; one rollout may allocate ``slot_memory_mb``.

    A scene's process that takes longer than ``fork_s`` to fork a slot is given up.
    """

    slots: int
    memory_mb: float
    slot_memory_mb: int = 2048
    fork_s: float = FORK_S
    sharing: bool = True
    """True if a slot executes the calls that plans have in common once."""

    @property
    def idle_slots(self) -> int:
        """Most idle processes over all scenes: at least one for each slot."""
        return max(self.slots, int(self.memory_mb * IDLE_MEMORY_SHARE / SLOT_MB))


@dataclass(slots=True)
class Slot:
    """Forked process that executes rollouts. A worn one has executed enough or has grown, and is replaced."""

    child: Child
    rollouts: float = 0.0
    first_mb: float = 0.0
    worn: bool = False


@dataclass(slots=True, eq=False)
class ResidentScene:
    """Scene that is loading, warm or failed. ``idle`` are slots that wait for its next rollout."""

    digest: str
    state: ResidentState = ResidentState.LOADING
    child: Child | None = None
    load_s: float = 0.0
    memory_mb: float = 0.0
    error: str = ""
    code: InfraCode = InfraCode.SCENE_LOAD_FAILED
    failed_s: float = 0.0
    last_used: int = 0
    execute_mean_s: float = 0.0
    """Moving average of the execution time; 0 before the first rollout."""
    running: int = 0
    idle: list[Slot] = field(default_factory=list)

    @property
    def needs_no_fork(self) -> bool:
        """True if a slot is idle, or none is busy: no process must be forked beside a busy one."""
        return bool(self.idle) or not self.running

    async def take_slot(self, fork_s: float) -> Slot:
        """Return an idle slot, or a new fork of the scene within ``fork_s`` seconds.

        Raise ProcessGoneError if the scene's process has died or does not answer.
        """
        if self.idle:
            return self.idle.pop()
        if self.child is None:
            raise ProcessGoneError("the scene was evicted")
        return Slot(await self.child.fork(fork_s))


class Residents:
    """Owner of the simulator's root and the scenes' processes.

    ``bundle_path`` returns a bundle's file, or raises LoadError. ``on_change`` gets each scene that was loaded, failed, evicted
    or lost.
    """

    def __init__(
        self,
        limits: SlotLimits,
        *,
        bundle_path: Callable[[str], Awaitable[Path]],
        on_change: Callable[[ResidentScene], None],
        log: Path,
        program: tuple[str, ...] = SIMULATOR_PROGRAM,
        board: ProgressBoard | None = None,
    ) -> None:
        self._limits = limits
        self._board = board
        self._bundle_path = bundle_path
        self._on_change = on_change
        self._log = log
        self._program = program
        self._root: Root | None = None
        self._root_turn = asyncio.Lock()
        self._scenes: dict[str, ResidentScene] = {}
        self._known_mb: dict[str, float] = {}
        self._ending: set[asyncio.Task[str]] = set()

    @property
    def memory_used_mb(self) -> float:
        """Private memory of the scenes' processes."""
        return sum(scene.memory_mb for scene in self._scenes.values())

    def report(self) -> tuple[Resident, ...]:
        return tuple(
            Resident(scene.digest, scene.state, scene.load_s, scene.memory_mb, scene.error[:SENTENCE])
            for scene in self._scenes.values()
        )

    def warm(self, digest: str) -> ResidentScene | None:
        """Return the scene if it can execute rollouts now."""
        scene = self._scenes.get(digest)
        return scene if scene is not None and scene.state is ResidentState.WARM else None

    def failed(self) -> bool:
        """Return whether a scene waits for another attempt to load it."""
        return any(scene.state is ResidentState.FAILED for scene in self._scenes.values())

    def retry(self, digest: str) -> None:
        """Forget a failure to load this scene."""
        scene = self._scenes.get(digest)
        if scene is not None and scene.state is ResidentState.FAILED:
            del self._scenes[digest]

    async def start(self) -> None:
        """Start the root. Raise ProcessGoneError with the reason if the engine can't be imported."""
        await self._ready_root()

    async def close(self) -> None:
        """End every process."""
        if self._root is not None:
            await self._root.end()
        await asyncio.gather(*self._ending)

    def update(self, wanted: Sequence[str], tasks: asyncio.TaskGroup, *, budget_mb: float) -> None:
        """Evict scenes beyond ``budget_mb``, and begin to load wanted ones, one for each slot at a time."""
        now_s = time.monotonic()
        for scene in list(self._scenes.values()):
            over = scene.digest not in wanted or now_s - scene.failed_s > RETRY_LOAD_S
            if scene.state is ResidentState.FAILED and over:
                del self._scenes[scene.digest]
        for digest in surplus(wanted, self._held(), budget_mb=budget_mb):
            self._evict(digest)
        while self._loading() < self._limits.slots:
            refused = self._scenes.keys() - self._held().keys()
            decision = decide(
                wanted, self._held(), budget_mb=budget_mb, known_mb=self._known_mb, refused=refused
            )
            for digest in decision.evict:
                self._evict(digest)
            if not decision.load:
                break
            scene = ResidentScene(decision.load, memory_mb=self._known_mb.get(decision.load, 0.0))
            self._scenes[scene.digest] = scene
            self._on_change(scene)
            tasks.create_task(self._load(scene))

    def shed(self) -> None:
        """Evict every scene in which nothing runs."""
        for digest, held in self._held().items():
            if not held.busy:
                self._evict(digest)

    def lost(self, scene: ResidentScene, reason: str) -> None:
        """Forget a scene whose process forks no more, so that it is loaded again if it is wanted.

        The process may only be stopped. Its slots would die with it, so it is ended after their last rollout.
        """
        if self.keeps(scene):
            logger.warning("scene lost scene=%s: %s", scene.digest, reason)
            self._forget(scene)

    def release(self, scene: ResidentScene) -> None:
        """Note the end of a run in the scene."""
        scene.running -= 1
        if not scene.running and not self.keeps(scene):
            self._end(scene)

    def keeps(self, scene: ResidentScene) -> bool:
        """Return whether this very scene is still held, neither evicted nor loaded again."""
        return self._scenes.get(scene.digest) is scene

    def keep_slot(self, scene: ResidentScene, slot: Slot) -> None:
        """Keep a slot for its scene's next rollout, unless the scene was evicted or lost meanwhile.

        If too many slots are idle, the least recently used scene gives one up.
        """
        if not self.keeps(scene):
            self.end_later(slot.child)
            return
        scene.idle.append(slot)
        if sum(len(other.idle) for other in self._scenes.values()) > self._limits.idle_slots:
            idle = (other for other in self._scenes.values() if other.idle)
            oldest = min(idle, key=lambda other: other.last_used)
            self.end_later(oldest.idle.pop(0).child)

    def end_later(self, child: Child) -> None:
        """Kill a process without waiting for its end.

        It is collected a little later, because its parent can't fork while it waits for a child.
        """
        child.kill()
        task = asyncio.create_task(_collect(child))
        self._ending.add(task)
        task.add_done_callback(self._ending.discard)

    def _held(self) -> dict[str, HeldScene]:
        return {
            scene.digest: HeldScene(
                scene.memory_mb, scene.last_used, scene.running > 0 or scene.state is ResidentState.LOADING
            )
            for scene in self._scenes.values()
            if scene.state is not ResidentState.FAILED
        }

    def _loading(self) -> int:
        return sum(scene.state is ResidentState.LOADING for scene in self._scenes.values())

    async def _load(self, scene: ResidentScene) -> None:
        started_s = time.monotonic()
        try:
            async with asyncio.timeout(LOAD_S):
                await self._load_child(scene)
        except (LoadError, ProcessGoneError, TimeoutError, OSError) as error:
            scene.state, scene.failed_s, scene.memory_mb = ResidentState.FAILED, time.monotonic(), 0.0
            scene.code = error.code if isinstance(error, LoadError) else InfraCode.SCENE_LOAD_FAILED
            late = f"it took longer than {LOAD_S:g} s"
            scene.error = late if isinstance(error, TimeoutError) else str(error)
            logger.warning("scene not loaded scene=%s: %s", scene.digest, scene.error)
        else:
            scene.state, scene.load_s = ResidentState.WARM, time.monotonic() - started_s
            self._known_mb[scene.digest] = scene.memory_mb
            while len(self._known_mb) > KNOWN_SCENES:
                del self._known_mb[next(iter(self._known_mb))]
            logger.info(
                "scene warm scene=%s in %.0f ms, %.1f MB", scene.digest, scene.load_s * 1e3, scene.memory_mb
            )
        self._on_change(scene)

    async def _load_child(self, scene: ResidentScene) -> None:
        path = await self._bundle_path(scene.digest)
        child = await self._fork_scene()
        request = {
            "path": str(path),
            "digest": scene.digest,
            "sharing": self._limits.sharing,
            "slot_memory_mb": self._limits.slot_memory_mb,
            "scene_memory_mb": max(int(self._limits.memory_mb), SMALLEST_LIMIT_MB),
        }
        try:
            answer = await child.peer.ask(PipeMessage(request))
        except ProcessGoneError as error:
            how = await child.end()
            raise ProcessGoneError(f"the simulator ended while loading it: {how}") from error
        except BaseException:
            self.end_later(child)
            raise
        if "error" in answer.header:
            await child.end()
            raise LoadError(InfraCode(answer.header["code"]), answer.header["error"])
        scene.child = child
        scene.memory_mb = float(answer.header["memory_mb"])

    async def _fork_scene(self) -> Child:
        root = await self._ready_root()
        try:
            return await root.fork()
        except ProcessGoneError:
            logger.warning("the simulator's root process died: starting it again")
            async with self._root_turn:
                if self._root is root:
                    await root.end()
                    self._root = None
            return await (await self._ready_root()).fork()

    async def _ready_root(self) -> Root:
        async with self._root_turn:
            if self._root is None:
                self._root = await start_root(self._log, self._program, self._board)
            return self._root

    def _evict(self, digest: str) -> None:
        """Forget a scene and end its process with its slots."""
        logger.info("scene evicted scene=%s", digest)
        scene = self._scenes[digest]
        self._forget(scene)
        self._end(scene)

    def _forget(self, scene: ResidentScene) -> None:
        del self._scenes[scene.digest]
        for slot in scene.idle:
            slot.child.close()
        scene.idle.clear()
        self._on_change(scene)

    def _end(self, scene: ResidentScene) -> None:
        if scene.child is not None:
            self.end_later(scene.child)
            scene.child = None


async def _collect(child: Child) -> str:
    await asyncio.sleep(COLLECT_S)
    return await child.end()
