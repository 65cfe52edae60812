"""Resource-Scheduler: decides which scenes each worker holds in memory, ahead of the rollouts that need them.

A pure state machine like the Task-Dispatcher. Trainers announce what the coming steps need, the dispatcher tells what is
needed now, workers report what they hold and how much memory it takes; the answer is one desired set per worker,
given again only when it changes.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from embomatrix.manager.commands import Command, SetDesired
from embomatrix.manager.events import (
    BatchSubmitted,
    DemandObserved,
    Event,
    LookaheadAnnounced,
    RunClosed,
    Tick,
    WorkerDrained,
    WorkerJoined,
    WorkerLost,
    WorkerRecovered,
    WorkerReported,
    WorkerSuspected,
)
from embomatrix.manager.placement import Need, Site, needs_of, place
from embomatrix.manager.prewarm import PrewarmLedger
from embomatrix.rpc.values import LookaheadEntry, Resident, ResidentState, Resources, Warmth

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


@dataclass(frozen=True, slots=True)
class ScheduleLimits:
    """Guesses and bounds of the scheduler; seconds and megabytes."""

    scene_mb: float = 64.0
    """Memory of a scene that no worker has loaded yet."""
    affinity_wait_s: float = 0.5
    """Rollouts wait this long for a worker that has their scene, or as long as loading it takes, before idle ones load it."""
    retry_load_s: float = 10.0
    """A worker that failed to load a scene is not asked again for this long."""


@dataclass(slots=True)
class _Holder:
    """A worker as the scheduler sees it. ``residents`` run from the most to the least recently used."""

    resources: Resources
    residents: dict[str, Resident] = field(default_factory=dict)
    warm_since_s: dict[str, float] = field(default_factory=dict)
    failed_s: dict[str, float] = field(default_factory=dict)
    desired: tuple[str, ...] | None = None
    reported: bool = False
    suspect: bool = False
    draining: bool = False

    @property
    def usable(self) -> bool:
        return self.reported and not self.draining and not self.suspect

    def standing(self) -> tuple[str, ...]:
        """Scenes that it has or was told to have, by last use. What it was told counts: its reports lag behind."""
        known = dict.fromkeys([*self.residents, *(self.desired or ())])
        failed = {s for s, resident in self.residents.items() if resident.state is ResidentState.FAILED}
        told = set(known if self.desired is None else self.desired)
        return tuple(
            sorted((scene for scene in known if scene not in failed), key=lambda scene: scene not in told)
        )

    def to_load(self, scenes: Iterable[str]) -> list[str]:
        """Those that are not warm here yet, in the same order."""
        return [scene for scene in scenes if scene not in self.warm_since_s]


@dataclass(frozen=True, slots=True)
class Window:
    """What a run announced last. Entries of steps that have come are dropped."""

    version: int
    entries: tuple[LookaheadEntry, ...]


class Scheduler:
    """Residents by memory. ``windows``, ``prewarm`` and ``unplaceable`` are for reading."""

    def __init__(self, limits: ScheduleLimits) -> None:
        self.windows: dict[str, Window] = {}
        self.prewarm = PrewarmLedger()
        self.unplaceable: dict[str, str] = {}
        """Scenes that no worker can hold, with the reason."""
        self._limits = limits
        self._holders: dict[str, _Holder] = {}
        self._demand = DemandObserved({})
        self._peaks: dict[str, int] = {}
        self._copies: dict[str, int] = {}
        self._size_mb: dict[str, float] = {}
        self._load_s: dict[str, float] = {}
        self._now_s = 0.0

    def handle(self, event: Event, *, now_s: float) -> list[Command]:
        """Take in one fact; returns the desired sets that changed."""
        return self.place(now_s=now_s) if self.note(event, now_s=now_s) else []

    def note(self, event: Event, *, now_s: float) -> bool:
        """Take in one fact without deciding on it yet; returns whether it may change what should be where."""
        self._now_s = now_s
        match event:
            case DemandObserved():
                self._on_demand(event)
            case LookaheadAnnounced(run_id, version, entries):
                if run_id in self.windows and version <= self.windows[run_id].version:
                    return False
                self.windows[run_id] = Window(version, entries)
            case BatchSubmitted():
                self._on_submitted(event)
            case RunClosed(run_id):
                self.windows.pop(run_id, None)
            case WorkerReported():
                self._on_reported(event)
            case WorkerJoined() | WorkerLost() | WorkerDrained() | WorkerSuspected() | WorkerRecovered():
                self._on_worker(event)
            case Tick():
                pass
            case _:
                return False
        return True

    def place(self, *, now_s: float) -> list[Command]:
        """Decide where every scene should be; returns the desired sets that changed."""
        self._now_s = now_s
        usable = {name: holder for name, holder in self._holders.items() if holder.usable}
        needs = needs_of(self._peaks, [window.entries for window in self.windows.values()])
        needs = [self._spread(need, usable) for need in needs]
        sites = [self._site(name, holder, needs) for name, holder in usable.items()]
        self.unplaceable = {
            need.bundle_digest: self._why_not(need.bundle_digest)
            for need in needs
            if sites and all(need.bundle_digest in site.refused for site in sites)
        }
        desired = place(sites, needs, self._estimate)
        orders = (self._order(name, scenes) for name, scenes in desired.items())
        return [order for order in orders if order is not None]

    def warmth(self, scene: str) -> Warmth:
        """How far the scene is, seen from its trainer."""
        if self._warm_since(scene) is not None:
            return Warmth.WARM
        if scene in self.unplaceable:
            return Warmth.UNPLACEABLE
        if any(scene in (holder.desired or ()) for holder in self._holders.values()):
            return Warmth.WARMING
        return Warmth.QUEUED

    def load_s(self, scene: str) -> float:
        """Measured seconds to load the scene; 0 when nobody has."""
        return self._load_s.get(scene, 0.0)

    def residents(self, worker_id: str) -> tuple[Resident, ...]:
        holder = self._holders.get(worker_id)
        return tuple(holder.residents.values()) if holder else ()

    def desired(self, worker_id: str) -> tuple[str, ...]:
        """The last desired set that was given for the worker."""
        holder = self._holders.get(worker_id)
        return (holder.desired or ()) if holder else ()

    def _on_demand(self, event: DemandObserved) -> None:
        self._demand = event
        self.prewarm.used(event.used)
        self._touch(event.used)
        # By its peak and not by what is left: a scene's copies shall not come and go while a batch runs down.
        self._peaks = {scene: max(count, self._peaks.get(scene, 0)) for scene, count in event.pending.items()}
        self._copies = {scene: self._copies[scene] for scene in event.pending if scene in self._copies}

    def _on_submitted(self, event: BatchSubmitted) -> None:
        batch = event.batch
        for scene in dict.fromkeys(rollout.bundle_digest for rollout in batch.rollouts):
            self.prewarm.demanded(batch.run_id, self._warm_since(scene), self._now_s)
        window = self.windows.get(batch.run_id)
        if window is not None:
            coming = tuple(entry for entry in window.entries if entry.step > batch.step)
            self.windows[batch.run_id] = Window(window.version, coming)

    def _on_worker(
        self, event: WorkerJoined | WorkerLost | WorkerDrained | WorkerSuspected | WorkerRecovered
    ) -> None:
        match event:
            case WorkerJoined(worker_id, resources):
                self.prewarm.lost(worker_id)
                self._holders[worker_id] = _Holder(resources)
            case WorkerLost(worker_id):
                self.prewarm.lost(worker_id)
                self._holders.pop(worker_id, None)
            case WorkerDrained(worker_id) if worker_id in self._holders:
                self._holders[worker_id].draining = True
            case WorkerSuspected(worker_id) | WorkerRecovered(worker_id) if worker_id in self._holders:
                self._holders[worker_id].suspect = isinstance(event, WorkerSuspected)
            case _:
                pass

    def _on_reported(self, event: WorkerReported) -> None:
        holder = self._holders.get(event.worker_id)
        if holder is None:
            return
        holder.reported = True
        holder.draining = holder.draining or event.draining
        if event.resync:
            # Whatever was told before may be lost: the desired set is given again.
            holder.desired = None
        reported = {resident.bundle_digest: resident for resident in event.residents}
        for scene in holder.residents.keys() - reported.keys():
            holder.warm_since_s.pop(scene, None)
            self.prewarm.evicted(event.worker_id, scene)
        known = [scene for scene in holder.residents if scene in reported]
        holder.residents = {scene: reported[scene] for scene in dict.fromkeys([*known, *reported])}
        for resident in event.residents:
            self._learn(holder, resident)

    def _learn(self, holder: _Holder, resident: Resident) -> None:
        scene = resident.bundle_digest
        if resident.memory_mb > 0:
            self._size_mb[scene] = max(self._size_mb.get(scene, 0.0), resident.memory_mb)
        match resident.state:
            case ResidentState.WARM:
                holder.warm_since_s.setdefault(scene, self._now_s)
                holder.failed_s.pop(scene, None)
                if resident.load_s > 0:
                    before_s = self._load_s.get(scene, resident.load_s)
                    self._load_s[scene] = 0.5 * (before_s + resident.load_s)
            case ResidentState.FAILED:
                holder.failed_s.setdefault(scene, self._now_s)
                holder.warm_since_s.pop(scene, None)
            case ResidentState.LOADING:
                holder.warm_since_s.pop(scene, None)
                holder.failed_s.pop(scene, None)

    def _touch(self, used: Iterable[tuple[str, str]]) -> None:
        """Scenes that were just used move to the front, so that among the needless the oldest goes first."""
        for worker_id, scene in used:
            holder = self._holders.get(worker_id)
            if holder is not None and scene in holder.residents:
                holder.residents = {scene: holder.residents[scene], **holder.residents}

    def _warm_since(self, scene: str) -> float | None:
        times = [h.warm_since_s[scene] for h in self._holders.values() if scene in h.warm_since_s]
        return min(times, default=None)

    def _site(self, name: str, holder: _Holder, needs: Iterable[Need]) -> Site:
        memory_mb = holder.resources.memory_mb
        refused = {
            scene for scene, at_s in holder.failed_s.items() if self._now_s - at_s < self._limits.retry_load_s
        }
        refused.update(n.bundle_digest for n in needs if self._size_mb.get(n.bundle_digest, 0.0) > memory_mb)
        held = holder.standing()
        return Site(
            worker_id=name,
            slots=max(holder.resources.slots, 1),
            score=holder.resources.score,
            memory_mb=memory_mb,
            residents=held,
            pinned=frozenset(scene for scene in held if (name, scene) in self._demand.in_use),
            refused=frozenset(refused),
        )

    def _spread(self, need: Need, usable: Mapping[str, _Holder]) -> Need:
        """One worker more for a scene whose rollouts wait while others are idle, unless one is loading it already."""
        scene = need.bundle_digest
        patience_s = max(self._limits.affinity_wait_s, self.load_s(scene))
        if self._demand.waited_s.get(scene, 0.0) >= patience_s:
            holders = {name for name, holder in usable.items() if scene in (holder.desired or ())}
            loading = any(scene not in usable[name].warm_since_s for name in holders)
            if not loading and self._demand.idle - holders:
                self._copies[scene] = len(holders) + 1
        return dataclasses.replace(need, at_least=self._copies.get(scene, 1))

    def _estimate(self, scene: str) -> float:
        return self._size_mb.get(scene, self._limits.scene_mb)

    def _why_not(self, scene: str) -> str:
        errors = [h.residents[scene].error for h in self._holders.values() if scene in h.residents]
        if any(errors):
            return f"scene {scene} fails to load: {next(filter(None, errors))}"
        largest_mb = max((holder.resources.memory_mb for holder in self._holders.values()), default=0)
        return (
            f"scene {scene} needs {self._estimate(scene):.0f} MB and the largest worker gives {largest_mb} MB: "
            f"raise a worker's memory limit"
        )

    def _order(self, name: str, scenes: tuple[str, ...]) -> SetDesired | None:
        """Tell the worker, if the set or the order of what it still has to load is another than it was told."""
        holder = self._holders[name]
        before = holder.desired
        if (
            before is not None
            and set(before) == set(scenes)
            and holder.to_load(before) == holder.to_load(scenes)
        ):
            return None
        for scene in holder.to_load(before or ()):
            if scene not in scenes and scene not in holder.residents:
                self.prewarm.withdrawn(name, scene)
        for scene in holder.to_load(scenes):
            run_id = self._announcer(scene)
            if run_id is not None and not self._demand.pending.get(scene):
                self.prewarm.ordered(name, scene, run_id)
        holder.desired = scenes
        return SetDesired(name, scenes)

    def _announcer(self, scene: str) -> str | None:
        for run_id, window in self.windows.items():
            if any(entry.bundle_digest == scene for entry in window.entries):
                return run_id
        return None
