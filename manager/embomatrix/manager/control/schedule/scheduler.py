"""Resource-Scheduler: decides which scenes each worker holds in memory, ahead of the rollouts that need them.

A pure state machine like the Task-Dispatcher. Its inputs are the look-ahead of trainers, the demand of the dispatcher and
the reports of workers. Its output is one desired set per worker, sent again only when it changes.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from embomatrix.manager.control.commands import ManagerCommand, SetDesired
from embomatrix.manager.control.events import (
    BatchRestored,
    BatchSubmitted,
    DemandObserved,
    DrainChanged,
    Event,
    LeaseFinished,
    LookaheadAnnounced,
    RunClosed,
    RunOpened,
    SuspicionChanged,
    Tick,
    WorkerJoined,
    WorkerLost,
    WorkerReported,
)
from embomatrix.manager.control.schedule.lookahead import LookaheadWindow, PrewarmLedger
from embomatrix.manager.control.schedule.placement import Need, RunShare, needs_of, place
from embomatrix.manager.control.schedule.readiness import ReadinessForecast, SceneCosts, refusal_reason
from embomatrix.manager.control.schedule.residency import Residencies, ResidencySites
from embomatrix.manager.control.workers import WorkerRecord
from embomatrix.rpc.wire.values import Batch, Completed, Resident, RunTerms

DEFAULT_TERMS: Final = RunTerms()
OVERDUE: Final = 3.0
"""Multiple of the usual load time after which a load is no longer waited for."""
MOST_NEEDS: Final = 2_048
"""Scenes placed at once: the most urgent ones. Workers hold fewer, and a placement takes time for each."""
LEASES_AT_A_TIME: Final = 64
"""Live leases whose cost in a placement equals that of one worker."""


class Urgency(IntEnum):
    """Urgency of a new placement."""

    NONE = 0
    LATER = 1
    """A scene may be better on another worker."""
    NOW = 2
    """A needed scene is in no worker's desired set."""


@dataclass(frozen=True, slots=True)
class ScheduleLimits:
    """Estimates and bounds of the scheduler; seconds and megabytes."""

    scene_mb: float = 64.0
    """Assumed memory of a scene that no worker has loaded yet."""
    affinity_wait_s: float = 0.5
    """Idle workers load a scene too when its rollouts have waited for its load time, or this long while that is unknown."""
    retry_load_s: float = 10.0
    """Pause before a worker that failed to load a scene tries it again."""


class Scheduler:
    """``workers`` is the dispatcher's view of them: their standing must be up to date before ``note`` is called."""

    def __init__(self, limits: ScheduleLimits, workers: Mapping[str, WorkerRecord]) -> None:
        self.windows: dict[str, LookaheadWindow] = {}
        self.prewarm = PrewarmLedger()
        self.unplaceable: dict[str, str] = {}
        """Reason for each scene that no worker can hold."""
        self._limits = limits
        self._workers = workers
        self._residencies = Residencies()
        self._terms: dict[str, RunTerms] = {}
        self._demand = DemandObserved({})
        self._peaks: dict[str, int] = {}
        self._copies: dict[str, int] = {}
        self._costs = SceneCosts(limits.scene_mb)
        self._now_s = 0.0
        self.cost = 0
        """CPU accounting of the last placement: needs and workers that it examined."""

    def note(self, event: Event, *, now_s: float) -> Urgency:
        """Apply an event without a new placement; return the urgency of one."""
        self._now_s = now_s
        match event:
            case DemandObserved():
                self._on_demand(event)
            case LookaheadAnnounced():
                return self._on_announced(event)
            case BatchSubmitted():
                return self._on_submitted(event)
            case BatchRestored(batch):
                self._consume(batch)
                return Urgency.LATER
            case RunOpened(run_id, terms):
                self._terms[run_id] = terms
            case RunClosed(run_id):
                self.windows.pop(run_id, None)
                self._terms.pop(run_id, None)
            case WorkerReported():
                return self._on_reported(event)
            case LeaseFinished(outcome=Completed(timings=timings)):
                self._costs.executed(timings.execute_s * self._residencies.speed_of(event.worker_id))
                return Urgency.NONE
            case WorkerJoined() | WorkerLost():
                return self._on_presence(event)
            case SuspicionChanged() | DrainChanged():
                return self.standing_changed(event.worker_id)
            case Tick():
                return Urgency.LATER if self._demand.pending or self._residencies.failing else Urgency.NONE
            case _:
                return Urgency.NONE
        return Urgency.LATER

    def place(self, *, now_s: float) -> list[ManagerCommand]:
        """Place every needed scene; return the desired sets that changed."""
        self._now_s = now_s
        needs = needs_of(self._peaks, [window.entries for window in self.windows.values()])
        if len(needs) > MOST_NEEDS:
            waiting = {scene: turn for turn, scene in enumerate(self._demand.waited_s)}
            needs.sort(key=lambda need: (need.rank, waiting.get(need.bundle_digest, MOST_NEEDS)))
            del needs[MOST_NEEDS:]
        # The run whose turn is next owns a scene, else the first run that announced it.
        owners = {scene: run for run, window in reversed(self.windows.items()) for scene in window.scenes}
        owners |= self._demand.runs
        turns = {scene: turn for turn, scene in enumerate(self._demand.waited_s)}
        needs = [
            self._spread(
                need, turns.get(need.bundle_digest, 0), self._share(owners.get(need.bundle_digest, ""))
            )
            for need in needs
        ]
        sites = ResidencySites(
            self._residencies,
            now_s,
            self._demand.in_use,
            self._limits.retry_load_s,
            needs=needs,
        )
        placement = place(sites, needs, self._costs.size_mb)
        self._residencies.fresh.clear()
        refused = [scene for scene in placement.unplaced if sites.all_refuse(scene)]
        self.unplaceable = self._refusal_reasons(refused) if refused else {}
        self.cost = len(needs) + len(placement.desired) + len(self._demand.in_use) // LEASES_AT_A_TIME
        orders = (self._order(name, scenes) for name, scenes in placement.desired.items())
        return [order for order in orders if order is not None]

    def standing_changed(self, worker_id: str) -> Urgency:
        """Take over a changed standing of the worker."""
        residency = self._residencies.by_id.get(worker_id)
        if residency is None:
            return Urgency.NONE
        self._residencies.changed(residency)
        return Urgency.NOW

    @property
    def readiness(self) -> ReadinessForecast:
        return ReadinessForecast(self._residencies, self.unplaceable, self._costs, self._now_s)

    def residents(self, worker_id: str) -> tuple[Resident, ...]:
        residency = self._residencies.by_id.get(worker_id)
        return tuple(residency.residents.values()) if residency else ()

    def desired(self, worker_id: str) -> tuple[str, ...]:
        """Return the last desired set of the worker."""
        residency = self._residencies.by_id.get(worker_id)
        return (residency.desired or ()) if residency else ()

    def check_invariants(self) -> None:
        """Raise AssertionError if the workers or an index disagree with the dispatcher's workers."""
        residencies = self._residencies
        assert residencies.by_id.keys() == self._workers.keys()
        for name, residency in residencies.by_id.items():
            assert residency.worker is self._workers[name], name
            assert residency.listed == residency.worker.usable, name
        assert [(-r.capacity, name) for name, r in sorted(residencies.by_id.items()) if r.listed] == sorted(
            residencies.order, key=lambda entry: entry[1]
        )
        assert residencies.order == sorted(residencies.order)

    def _on_demand(self, event: DemandObserved) -> None:
        self._demand = event
        self._residencies.limit_scores(event.lags)
        self.prewarm.used(event.used)
        self._residencies.touch(event.used)
        # Peaks, not what is left: the number of copies must not change while a batch runs down.
        self._peaks = {scene: max(count, self._peaks.get(scene, 0)) for scene, count in event.pending.items()}
        self._copies = {scene: self._copies[scene] for scene in event.pending if scene in self._copies}

    def _on_announced(self, event: LookaheadAnnounced) -> Urgency:
        if event.run_id in self.windows and event.version <= self.windows[event.run_id].version:
            return Urgency.NONE
        self.windows[event.run_id] = LookaheadWindow(event.version, event.entries)
        return Urgency.NOW

    def _on_submitted(self, event: BatchSubmitted) -> Urgency:
        batch, urgency = event.batch, Urgency.LATER
        for scene in dict.fromkeys(rollout.bundle_digest for rollout in batch.rollouts):
            if not batch.has_turns:
                self.prewarm.demanded(batch.run_id, self._residencies.warm_since_s(scene), self._now_s)
            if not self._residencies.having(scene):
                urgency = Urgency.NOW
        if not batch.has_turns:
            # Turns use nothing up: more turns of the episode follow in the same scene.
            self._consume(batch)
        return urgency

    def _consume(self, batch: Batch) -> None:
        window = self.windows.get(batch.run_id)
        if window is not None:
            window.consume(batch)

    def _on_presence(self, event: WorkerJoined | WorkerLost) -> Urgency:
        self.prewarm.lost(event.worker_id)
        match event:
            case WorkerJoined(worker_id):
                if worker_id in self._workers:
                    self._residencies.join(self._workers[worker_id])
                return Urgency.NONE
            case WorkerLost(worker_id):
                self._costs.forget(worker_id)
                self._residencies.leave(worker_id)
                return Urgency.NOW

    def _on_reported(self, event: WorkerReported) -> Urgency:
        residency = self._residencies.by_id.get(event.worker_id)
        if residency is None:
            return Urgency.NONE
        urgency = Urgency.LATER if residency.worker.usable == residency.listed else Urgency.NOW
        if event.resync:
            # Earlier orders may be lost: the desired set is sent again.
            residency.desired, urgency = None, Urgency.NOW
        reported = {resident.bundle_digest: resident for resident in event.residents}
        for scene in residency.residents.keys() - reported.keys():
            residency.warm_since_s.pop(scene, None)
            residency.loading_since_s.pop(scene, None)
            self.prewarm.evicted(event.worker_id, scene)
        known = [scene for scene in residency.residents if scene in reported]
        residency.residents = {scene: reported[scene] for scene in dict.fromkeys([*known, *reported])}
        for resident in event.residents:
            residency.note(resident, self._now_s)
            self._costs.learn(event.worker_id, resident)
        self._residencies.changed(residency)
        return urgency

    def _share(self, run_id: str) -> RunShare:
        terms = self._terms.get(run_id, DEFAULT_TERMS)
        return RunShare(run_id, terms.weight, terms.priority)

    def _spread(self, need: Need, turn: int, share: RunShare) -> Need:
        """Complete a need; ask for one more copy if rollouts wait while workers idle and none is loading the scene."""
        scene = need.bundle_digest
        waited_s = self._demand.waited_s.get(scene, 0.0)
        ordered = [r for r in self._residencies.having(scene) if scene in (r.desired or ())]
        # The load time on slow workers says nothing about the others.
        load_s = self._costs.typical_load_s if all(r.is_slow for r in ordered) else self._costs.load_s(scene)
        if waited_s >= (load_s or self._limits.affinity_wait_s):
            overdue_s = max(OVERDUE * self._costs.usual_load_s(scene), self._limits.affinity_wait_s)
            loading = any(r.loads_in_time(scene, self._now_s, overdue_s) for r in ordered)
            if not loading and not self._demand.idle <= {r.worker_id for r in ordered}:
                self._copies[scene] = len(ordered) + 1
        return dataclasses.replace(
            need,
            at_least=self._copies.get(scene, 1),
            load_s=self._costs.usual_load_s(scene),
            work_s=need.count * self._costs.execute_s,
            turn=turn,
            share=share,
            render=need.render or scene in self._demand.rendering,
        )

    def _refusal_reasons(self, scenes: Iterable[str]) -> dict[str, str]:
        """Return why no worker takes each of these scenes."""
        rendering = {e.bundle_digest for w in self.windows.values() for e in w.entries if e.render}
        rendering |= self._demand.rendering
        return {
            scene: refusal_reason(
                self._residencies, scene, self._costs.size_mb(scene), renders=scene in rendering
            )
            for scene in scenes
        }

    def _order(self, name: str, scenes: tuple[str, ...]) -> SetDesired | None:
        """Return the order for a worker; None if neither the set nor the order of its loads changes."""
        residency = self._residencies.by_id[name]
        before, ordered = residency.desired, set(scenes)
        if (
            before is not None
            and set(before) == ordered
            and residency.to_load(before) == residency.to_load(scenes)
        ):
            return None
        for scene in residency.to_load(before or ()):
            if scene not in ordered and scene not in residency.residents:
                self.prewarm.withdrawn(name, scene)
        for scene in residency.to_load(scenes):
            run_id = next((run for run, window in self.windows.items() if window.announces(scene)), None)
            if run_id is not None and not self._demand.pending.get(scene):
                self.prewarm.ordered(name, scene, run_id)
        residency.desired = scenes
        self._residencies.changed(residency)
        self._residencies.fresh.discard(name)
        return SetDesired(name, scenes, cause=self._demand)
