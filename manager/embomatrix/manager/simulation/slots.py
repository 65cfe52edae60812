"""Slots and resident scenes of a simulated worker: executions and loads in simulated time."""

from __future__ import annotations

import random
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from embomatrix.manager.simulation.machines import SimulatedMachine, SimulatedWorld
from embomatrix.reward.breakdown import AtomResult, RewardBreakdown
from embomatrix.rpc.wire.leases import Lease, LeaseProgress, LeaseRef, LeaseResult
from embomatrix.rpc.wire.values import Completed, InfraCode, InfraFailure, Resident, ResidentState, Timings

RETRY_LOAD_S: Final = 10.0
"""Pause before a failed load is tried again, as in the real worker."""
RESPAWN_S: Final = 0.02
"""Time until a killed or crashed slot has a new process."""
STEP_S: Final = 0.1
_HALF: Final = (AtomResult("one", True), AtomResult("other", False))
_WHOLE: Final = (AtomResult("one", True), AtomResult("other", True))
REWARD: Final = RewardBreakdown(0.5, 0.0, 15.0, _HALF, False)
INVENTED: Final = RewardBreakdown(0.5, 0.0, 30.0, _WHOLE, True)


@dataclass(slots=True, eq=False)
class _Scene:
    memory_mb: float
    load_s: float
    state: ResidentState = ResidentState.LOADING
    failed_s: float = 0.0
    last_used: int = 0
    running: int = 0


class SimulatedSlots:
    """Slots of one worker process. ``stop`` ends all activity; ``fetched`` bundles stay on disk.

    ``on_result`` receives each result; ``on_change`` is called after the residents changed.
    """

    def __init__(
        self,
        machine: SimulatedMachine,
        world: SimulatedWorld,
        dice: random.Random,
        fetched: set[str],
        on_result: Callable[[LeaseResult], None],
        on_change: Callable[[], None],
    ) -> None:
        self._machine = machine
        self._setting = world.setting
        self._faults = world.setting.scenario.faults
        self._queue = world.queue
        self._report = world.report
        self._dice = dice
        self._fetched = fetched
        self._on_result = on_result
        self._on_change = on_change
        self._stopped = False
        self._wanted: tuple[str, ...] = ()
        self._scenes: dict[str, _Scene] = {}
        self._waiting: deque[Lease] = deque()
        self._running: dict[LeaseRef, tuple[Lease, float]] = {}
        self._stuck_s: dict[LeaseRef, float] = {}
        """Time of the last step of executions that never end."""
        self._free = machine.resources.slots
        self._clock = 0

    @property
    def executing(self) -> int:
        return len(self._running)

    def executing_of(self) -> Counter[str]:
        """Return the number of executing rollouts by run."""
        return Counter(lease.rollout.rollout_id.split(".", 1)[0] for lease, _ in self._running.values())

    def progress(self) -> tuple[LeaseProgress, ...]:
        """Return the steps of running leases: one per ``STEP_S`` until the execution hangs."""
        now_s = self._queue.now_s
        return tuple(
            LeaseProgress(ref, int((min(now_s, self._stuck_s.get(ref, now_s)) - began_s) / STEP_S))
            for ref, (_, began_s) in self._running.items()
        )

    def held(self) -> tuple[LeaseRef, ...]:
        """Return the leases that run or wait."""
        return (*self._running, *(lease.ref for lease in self._waiting))

    def residents(self) -> tuple[Resident, ...]:
        return tuple(
            Resident(
                digest,
                scene.state,
                scene.load_s if scene.state is ResidentState.WARM else 0.0,
                scene.memory_mb if scene.state is ResidentState.WARM else 0.0,
                "no such mesh" if scene.state is ResidentState.FAILED else "",
            )
            for digest, scene in self._scenes.items()
        )

    def stop(self) -> None:
        """End the process and all its activity."""
        self._stopped = True
        self._running.clear()
        self._waiting.clear()

    def count_unused(self) -> None:
        """Count loads that were never used, at the end of the simulation."""
        for scene in self._scenes.values():
            self._report.loads_unused += scene.state is ResidentState.WARM and not scene.last_used

    def want(self, digests: tuple[str, ...]) -> None:
        self._wanted = digests
        self._settle()

    def submit(self, lease: Lease) -> None:
        scene = self._scenes.get(lease.rollout.bundle_digest)
        if scene is not None and scene.state is ResidentState.FAILED:
            del self._scenes[lease.rollout.bundle_digest]
        self._waiting.append(lease)
        if scene is None or scene.state is not ResidentState.WARM:
            self._settle()
        self._start()

    def cancel(self, refs: set[LeaseRef]) -> None:
        """Drop these leases; slots that run them are killed and respawn."""
        for ref in [ref for ref in self._running if ref in refs]:
            lease, _ = self._running.pop(ref)
            self._leave(lease)
            self._queue.after(RESPAWN_S, self._free_slot)
        self._waiting = deque(lease for lease in self._waiting if lease.ref not in refs)

    def _settle(self) -> None:
        """Load the most urgent scenes, one per slot at a time."""
        loading = sum(scene.state is ResidentState.LOADING for scene in self._scenes.values())
        begun = False
        while loading < self._machine.resources.slots and not self._stopped:
            digest = self._next_load()
            if not digest:
                break
            self._load(digest)
            loading, begun = loading + 1, True
        if begun:
            self._on_change()

    def _next_load(self) -> str:
        """Evict for, and return, the most urgent missing scene that fits; empty if there is none."""
        now_s = self._queue.now_s
        for digest, scene in list(self._scenes.items()):
            if scene.state is ResidentState.FAILED and now_s - scene.failed_s >= RETRY_LOAD_S:
                del self._scenes[digest]
        wanted = tuple(
            dict.fromkeys((*(lease.rollout.bundle_digest for lease in self._waiting), *self._wanted))
        )
        held = {d: s for d, s in self._scenes.items() if s.state is not ResidentState.FAILED}
        place = next((at for at, digest in enumerate(wanted) if digest not in self._scenes), None)
        if place is None:
            return ""
        digest = wanted[place]
        need_mb = self._setting.scenes[digest].memory_mb
        free_mb = self._machine.resources.memory_mb - sum(scene.memory_mb for scene in held.values())
        evicted: list[str] = []
        for victim in _victims(wanted, place, held):
            if need_mb <= free_mb:
                break
            evicted.append(victim)
            free_mb += held[victim].memory_mb
        if need_mb > free_mb and len(evicted) < len(held):
            return ""
        for victim in evicted:
            self._report.loads_unused += not self._scenes.pop(victim).last_used
        return digest

    def _load(self, digest: str) -> None:
        size, machine = self._setting.scenes[digest], self._machine
        load_s = size.load_s / machine.speed
        fetch_s = 0.0
        if digest not in self._fetched:
            self._fetched.add(digest)
            fetch_s = 2 * machine.latency_s + size.bundle_mb / machine.bandwidth_mb_s
        scene = self._scenes[digest] = _Scene(size.memory_mb, load_s)
        self._report.loads += 1
        fails = self._dice.random() < self._faults.load_failure
        self._queue.after(fetch_s + load_s, lambda: self._loaded(digest, scene, fails=fails))

    def _loaded(self, digest: str, scene: _Scene, *, fails: bool) -> None:
        if self._stopped or self._scenes.get(digest) is not scene:
            return
        scene.state = ResidentState.FAILED if fails else ResidentState.WARM
        if fails:
            scene.failed_s = self._queue.now_s
            self._queue.after(RETRY_LOAD_S, self._settle)
            failure = InfraFailure(InfraCode.SCENE_LOAD_FAILED, "no such mesh", self._machine.worker_id)
            for lease in [lease for lease in self._waiting if lease.rollout.bundle_digest == digest]:
                self.cancel({lease.ref})
                self._on_result(LeaseResult(lease.ref, failure))
        self._on_change()
        self._settle()
        self._start()

    def _start(self) -> None:
        """Start waiting leases with a warm scene on free slots, in order."""
        for _ in range(len(self._waiting)):
            if not self._free:
                return
            lease = self._waiting.popleft()
            scene = self._scenes.get(lease.rollout.bundle_digest)
            if scene is None or scene.state is not ResidentState.WARM:
                self._waiting.append(lease)
            else:
                self._execute(lease, scene)

    def _execute(self, lease: Lease, scene: _Scene) -> None:
        self._clock += 1
        scene.last_used = self._clock
        scene.running += 1
        self._free -= 1
        began_s = self._queue.now_s
        self._running[lease.ref] = lease, began_s
        rendering = sum(running.rollout.render for running, _ in self._running.values())
        self._report.counts["rendered without a slot for it"] += (
            rendering > self._machine.resources.render_slots
        )
        rollout_id = lease.rollout.rollout_id
        seconds = self._setting.duration_s(rollout_id) / self._machine.speed
        fate, crash, hang = self._dice.random(), self._faults.crash, self._faults.hang
        outcome: Completed | InfraFailure
        if fate < crash:
            seconds *= fate / crash
            outcome = InfraFailure(InfraCode.SLOT_CRASHED, "segmentation fault", self._machine.worker_id)
        elif fate < crash + hang or seconds > lease.deadline_s:
            if fate < crash + hang:
                self._stuck_s[lease.ref] = began_s + seconds * (fate - crash) / hang
            seconds = lease.deadline_s
            outcome = InfraFailure(InfraCode.SLOT_TIMEOUT, "killed", self._machine.worker_id)
        else:
            timings = Timings(execute_s=seconds)
            outcome = self._result(rollout_id, timings)
        self._queue.after(seconds, lambda: self._finished(lease, outcome))

    def _result(self, rollout_id: str, timings: Timings) -> Completed:
        """Return a result whose trace names its rollout, unless the machine lies."""
        lies, worker_id = self._machine.lies, self._machine.worker_id
        if lies and self._dice.random() < lies:
            return Completed(
                INVENTED, (), (), f"{rollout_id} as {worker_id} has it", worker_id, timings, warm=True
            )
        return Completed(REWARD, (), (), rollout_id, worker_id, timings, warm=True)

    def _finished(self, lease: Lease, outcome: Completed | InfraFailure) -> None:
        if self._running.pop(lease.ref, None) is None or self._stopped:
            return
        self._leave(lease)
        if isinstance(outcome, Completed):
            self._free += 1
        else:
            self._queue.after(RESPAWN_S, self._free_slot)
        self._on_result(LeaseResult(lease.ref, outcome))
        self._start()

    def _leave(self, lease: Lease) -> None:
        self._stuck_s.pop(lease.ref, None)
        scene = self._scenes.get(lease.rollout.bundle_digest)
        if scene is not None:
            scene.running -= 1

    def _free_slot(self) -> None:
        self._free += 1
        self._start()


def _victims(wanted: tuple[str, ...], place: int, held: dict[str, _Scene]) -> list[str]:
    """Return the scenes to evict for the scene at ``place``: unwanted ones by last use, then less urgent ones."""
    kept = set(wanted)
    unwanted = [digest for digest in held if digest not in kept and not held[digest].running]
    unwanted.sort(key=lambda digest: held[digest].last_used)
    later = [digest for digest in wanted[place + 1 :] if digest in held and not held[digest].running]
    return unwanted + later[::-1]
