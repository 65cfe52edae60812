"""The scenes that a worker holds: fetched, loaded into processes of their own, evicted when memory is short."""

from __future__ import annotations

import asyncio
import logging
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.wire.values import InfraCode, Resident, ResidentState
from embomatrix.sim.zygote import PipeMessage
from embomatrix.worker.slots.processes import FORK_S, SIMULATOR_PROGRAM, ProcessGoneError, start_root
from embomatrix.worker.slots.residency import HeldScene, decide, surplus

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence
    from pathlib import Path

    from embomatrix.worker.slots.processes import Child, Root
    from embomatrix.worker.slots.progress import ProgressBoard

logger = logging.getLogger(__name__)

COLLECT_S: Final = 0.05
"""How long the system may take to tear a killed process down before its parent is asked to collect it."""
LOAD_S: Final = 60.0
"""Limit for fetching and loading one scene."""
RETRY_LOAD_S: Final = 5.0
"""A scene that could not be loaded is tried again after this long, while it is still wanted."""


SLOT_MB: Final = 8.0
IDLE_MEMORY_SHARE: Final = 0.25
"""Idle processes may hold this share of the worker's memory, at about 8 MB each. A step's scenes come back step after step,
and a process that is kept is spared a fork and its page faults."""


class LoadError(Exception):
    """A scene that can't be loaded, with the code that tells the manager why."""

    def __init__(self, code: InfraCode, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True)
class SlotLimits:
    """What a worker may use. ``memory_mb`` is for all residents; one rollout may allocate ``slot_memory_mb``.

    A scene's process that takes longer than ``fork_s`` to fork a slot is given up.
    """

    slots: int
    memory_mb: float
    slot_memory_mb: int = 2048
    fork_s: float = FORK_S

    @property
    def idle_slots(self) -> int:
        """Processes that may wait for a next rollout, over all scenes: as many as there are slots at least."""
        return max(self.slots, int(self.memory_mb * IDLE_MEMORY_SHARE / SLOT_MB))


@dataclass(slots=True)
class Slot:
    """A forked process that executes rollouts."""

    child: Child
    rollouts: int = 0
    first_mb: float = 0.0
    worn: bool = False
    """It has done enough, or has grown: another one takes its place."""


@dataclass(slots=True, eq=False)
class ResidentScene:
    """A scene that is loading, warm or failed. ``idle`` are slots that wait for its next rollout."""

    digest: str
    state: ResidentState = ResidentState.LOADING
    child: Child | None = None
    load_s: float = 0.0
    memory_mb: float = 0.0
    error: str = ""
    code: InfraCode = InfraCode.SCENE_LOAD_FAILED
    failed_s: float = 0.0
    last_used: int = 0
    pace_s: float = 0.0
    """What a rollout took of late, on average; 0 before the first."""
    running: int = 0
    idle: list[Slot] = field(default_factory=list)

    @property
    def at_hand(self) -> bool:
        """Whether a slot waits for a rollout, or none is at work: nothing must be forked beside another."""
        return bool(self.idle) or not self.running

    async def take_slot(self, fork_s: float) -> Slot:
        """An idle slot, or a new fork of the scene, which may take ``fork_s`` seconds.

        Raises ProcessGoneError when the scene's process has died, or does not answer.
        """
        if self.idle:
            return self.idle.pop()
        if self.child is None:
            raise ProcessGoneError("the scene was evicted")
        return Slot(await self.child.fork(fork_s))


class Residents:
    """Owns the simulator's root and the scenes' processes.

    ``bundle_path`` brings a bundle to disk and raises LoadError when it can't. ``on_change`` is called with each scene
    that was loaded, failed, evicted or lost.
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
            Resident(scene.digest, scene.state, scene.load_s, scene.memory_mb, scene.error)
            for scene in self._scenes.values()
        )

    def warm(self, digest: str) -> ResidentScene | None:
        """The scene, if rollouts can be executed in it now."""
        scene = self._scenes.get(digest)
        return scene if scene is not None and scene.state is ResidentState.WARM else None

    def failed(self) -> bool:
        """Whether a scene waits to be tried again."""
        return any(scene.state is ResidentState.FAILED for scene in self._scenes.values())

    def retry(self, digest: str) -> None:
        """Forget that this scene could not be loaded."""
        scene = self._scenes.get(digest)
        if scene is not None and scene.state is ResidentState.FAILED:
            del self._scenes[digest]

    async def start(self) -> None:
        """Start the root. Raises ProcessGoneError with the reason when the engine can't be imported."""
        await self._ready_root()

    async def close(self) -> None:
        """End every process."""
        if self._root is not None:
            await self._root.end()
        await asyncio.gather(*self._ending)

    def settle(self, wanted: Sequence[str], tasks: asyncio.TaskGroup, *, budget_mb: float) -> None:
        """Evict what is more than ``budget_mb``, and begin to load what is wanted: as many at a time as there are slots."""
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
        """The scene's process forks no more: forget the scene, so that it is loaded anew when it is wanted.

        It may be stopped and not dead, and rollouts may run in slots that it forked before and that would die with it: it is
        ended when the last of them is done.
        """
        if self.keeps(scene):
            logger.warning("scene lost scene=%s: %s", scene.digest, reason)
            self._forget(scene)

    def release(self, scene: ResidentScene) -> None:
        """A rollout in the scene is done."""
        scene.running -= 1
        if not scene.running and not self.keeps(scene):
            self._end(scene)

    def keeps(self, scene: ResidentScene) -> bool:
        """Whether this very scene is still held, not evicted or loaded anew."""
        return self._scenes.get(scene.digest) is scene

    def keep_slot(self, scene: ResidentScene, slot: Slot) -> None:
        """Keep a slot for its scene's next rollout, unless the scene was dropped meanwhile.

        When too many are idle, the scene that was not used for longest gives one up.
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

        It is collected a little later: whom its parent waits for, it can't fork another one meanwhile.
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
            "slot_memory_mb": self._limits.slot_memory_mb,
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
            logger.warning("the simulator's root process died: starting it anew")
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
        logger.info("scene evicted scene=%s", digest)
        self._drop(self._scenes[digest])

    def _drop(self, scene: ResidentScene) -> None:
        """Forget a scene and end its process; its slots die with it."""
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
