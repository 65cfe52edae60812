"""Resource-Scheduler: decides which scenes each worker holds in memory, ahead of the rollouts that need them.

A pure state machine like the Task-Dispatcher. Trainers announce what the coming steps need, the dispatcher tells what is
needed now, workers report what they hold and how much memory it takes; the answer is one desired set per worker,
given again only when it changes.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from embomatrix.manager.control.commands import Command, SetDesired
from embomatrix.manager.control.events import (
    BatchRestored,
    BatchSubmitted,
    DemandObserved,
    Event,
    LeaseFinished,
    LookaheadAnnounced,
    RunClosed,
    RunOpened,
    Tick,
    WorkerDrained,
    WorkerJoined,
    WorkerLost,
    WorkerQuarantined,
    WorkerRecovered,
    WorkerReported,
    WorkerResumed,
    WorkerSuspected,
)
from embomatrix.manager.control.schedule.holders import Holders, Places
from embomatrix.manager.control.schedule.lookahead_window import LookaheadWindow, announcers
from embomatrix.manager.control.schedule.outlook import Outlook, why_not
from embomatrix.manager.control.schedule.placement import Need, needs_of, place
from embomatrix.manager.control.schedule.prewarm import PrewarmLedger
from embomatrix.manager.control.schedule.scene_costs import SceneCosts
from embomatrix.manager.control.shares import RunShare
from embomatrix.rpc.wire.values import Batch, Completed, Resident, RunTerms

DEFAULT_TERMS: Final = RunTerms()
OVERDUE: Final = 3.0
"""A load that takes so many times longer than usual is not waited for."""
LEASES_AT_A_TIME: Final = 64
"""So many leases are told of at the price of looking at one worker."""


class Urgency(IntEnum):
    """What a fact means for where scenes should be."""

    NONE = 0
    LATER = 1
    """Something may be better elsewhere."""
    NOW = 2
    """Something is needed that nobody was told to load."""


@dataclass(frozen=True, slots=True)
class ScheduleLimits:
    """Guesses and bounds of the scheduler; seconds and megabytes."""

    scene_mb: float = 64.0
    """Memory of a scene that no worker has loaded yet."""
    affinity_wait_s: float = 0.5
    """Rollouts wait as long as loading their scene takes before idle workers load it too; this long while that isn't known."""
    retry_load_s: float = 10.0
    """A worker that failed to load a scene is not asked again for this long."""


class Scheduler:
    """Residents by memory. ``windows``, ``prewarm`` and ``unplaceable`` are for reading."""

    def __init__(self, limits: ScheduleLimits) -> None:
        self.windows: dict[str, LookaheadWindow] = {}
        self.prewarm = PrewarmLedger()
        self.unplaceable: dict[str, str] = {}
        """Scenes that no worker can hold, with the reason."""
        self._limits = limits
        self._holders = Holders()
        self._terms: dict[str, RunTerms] = {}
        self._demand = DemandObserved({})
        self._peaks: dict[str, int] = {}
        self._copies: dict[str, int] = {}
        self._costs = SceneCosts(limits.scene_mb)
        self._now_s = 0.0
        self.effort = 0
        """Needs and workers that the last placement looked at, and what it took to know what is in use."""

    def handle(self, event: Event, *, now_s: float) -> list[Command]:
        """Take in one fact; returns the desired sets that changed."""
        return self.place(now_s=now_s) if self.note(event, now_s=now_s) else []

    def note(self, event: Event, *, now_s: float) -> Urgency:
        """Take in one fact without deciding on it yet; returns how soon it wants a decision."""
        self._now_s = now_s
        match event:
            case DemandObserved():
                self._on_demand(event)
            case LookaheadAnnounced():
                return self._on_announced(event)
            case BatchSubmitted():
                return self._on_submitted(event)
            case BatchRestored(batch):
                self._come(batch)
                return Urgency.LATER
            case RunOpened(run_id, terms):
                self._terms[run_id] = terms
            case RunClosed(run_id):
                self.windows.pop(run_id, None)
                self._terms.pop(run_id, None)
            case WorkerReported():
                return self._on_reported(event)
            case LeaseFinished(outcome=Completed(timings=timings)):
                self._costs.executed(timings.execute_s * self._holders.speed_of(event.worker_id))
                return Urgency.NONE
            case WorkerJoined() | WorkerLost():
                return self._on_presence(event)
            case (
                WorkerDrained()
                | WorkerResumed()
                | WorkerSuspected()
                | WorkerRecovered()
                | WorkerQuarantined()
            ):
                return self._on_standing(event)
            case Tick():
                return Urgency.LATER if self._demand.pending or self._holders.failing else Urgency.NONE
            case _:
                return Urgency.NONE
        return Urgency.LATER

    def place(self, *, now_s: float) -> list[Command]:
        """Decide where every scene should be; returns the desired sets that changed."""
        self._now_s = now_s
        needs = needs_of(self._peaks, [window.entries for window in self.windows.values()])
        owners = {**announcers(self.windows), **self._demand.runs}
        turns = {scene: turn for turn, scene in enumerate(self._demand.waited_s)}
        needs = [
            self._spread(
                need, turns.get(need.bundle_digest, 0), self._share(owners.get(need.bundle_digest, ""))
            )
            for need in needs
        ]
        places = Places(self._holders, now_s, self._demand.in_use, self._limits.retry_load_s)
        places.refuse_where_too_large(needs, self._costs.known_mb)
        places.refuse_where_nothing_renders(needs)
        placement = place(places, needs, self._costs.size_mb)
        self._holders.fresh.clear()
        self.unplaceable = {
            scene: self._why_not(scene) for scene in placement.homeless if places.nobody_takes(scene)
        }
        self.effort = len(needs) + len(placement.desired) + len(self._demand.in_use) // LEASES_AT_A_TIME
        orders = (self._order(name, scenes) for name, scenes in placement.desired.items())
        return [order for order in orders if order is not None]

    @property
    def outlook(self) -> Outlook:
        """How far scenes are, at this moment."""
        return Outlook(self._holders, self.unplaceable, self._costs.usual_load_s, self._now_s)

    def residents(self, worker_id: str) -> tuple[Resident, ...]:
        holder = self._holders.by_id.get(worker_id)
        return tuple(holder.residents.values()) if holder else ()

    def desired(self, worker_id: str) -> tuple[str, ...]:
        """The last desired set that was given for the worker."""
        holder = self._holders.by_id.get(worker_id)
        return (holder.desired or ()) if holder else ()

    def _on_demand(self, event: DemandObserved) -> None:
        self._demand = event
        self._holders.limit_scores(event.lags)
        self.prewarm.used(event.used)
        self._holders.touch(event.used)
        # By its peak and not by what is left: a scene's copies shall not come and go while a batch runs down.
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
            self.prewarm.demanded(batch.run_id, self._warm_since(scene), self._now_s)
            if not self._holders.having(scene):
                urgency = Urgency.NOW
        self._come(batch)
        return urgency

    def _come(self, batch: Batch) -> None:
        window = self.windows.get(batch.run_id)
        if window is not None:
            window.come(batch)

    def _on_presence(self, event: WorkerJoined | WorkerLost) -> Urgency:
        self.prewarm.lost(event.worker_id)
        match event:
            case WorkerJoined(worker_id, resources):
                self._holders.join(worker_id, resources)
                return Urgency.NONE
            case WorkerLost(worker_id):
                self._holders.leave(worker_id)
                return Urgency.NOW

    def _on_standing(
        self,
        event: WorkerDrained | WorkerResumed | WorkerSuspected | WorkerRecovered | WorkerQuarantined,
    ) -> Urgency:
        holder = self._holders.by_id.get(event.worker_id)
        if holder is None:
            return Urgency.NONE
        match event:
            case WorkerDrained() | WorkerResumed():
                holder.drained = isinstance(event, WorkerDrained)
                holder.quarantined = holder.quarantined and isinstance(event, WorkerDrained)
            case WorkerQuarantined():
                holder.quarantined = True
            case WorkerSuspected() | WorkerRecovered():
                holder.suspect = isinstance(event, WorkerSuspected)
        self._holders.changed(holder)
        return Urgency.NOW

    def _on_reported(self, event: WorkerReported) -> Urgency:
        holder = self._holders.by_id.get(event.worker_id)
        if holder is None:
            return Urgency.NONE
        was_usable, holder.reported = holder.usable, True
        holder.leaving, holder.paused = event.draining, bool(event.paused)
        urgency = Urgency.LATER if holder.usable == was_usable else Urgency.NOW
        if event.resync:
            # Whatever was told before may be lost: the desired set is given again.
            holder.desired, urgency = None, Urgency.NOW
        reported = {resident.bundle_digest: resident for resident in event.residents}
        for scene in holder.residents.keys() - reported.keys():
            holder.warm_since_s.pop(scene, None)
            holder.loading_since_s.pop(scene, None)
            self.prewarm.evicted(event.worker_id, scene)
        known = [scene for scene in holder.residents if scene in reported]
        holder.residents = {scene: reported[scene] for scene in dict.fromkeys([*known, *reported])}
        for resident in event.residents:
            holder.note(resident, self._now_s)
            self._costs.learn(resident)
        self._holders.changed(holder)
        return urgency

    def _warm_since(self, scene: str) -> float | None:
        names = self._holders.warm_on(scene)
        return min((self._holders.by_id[name].warm_since_s[scene] for name in names), default=None)

    def _share(self, run_id: str) -> RunShare:
        terms = self._terms.get(run_id, DEFAULT_TERMS)
        return RunShare(run_id, terms.weight, terms.priority)

    def _spread(self, need: Need, turn: int, share: RunShare) -> Need:
        """One worker more for a scene whose rollouts wait while others are idle, unless one is loading it already."""
        scene = need.bundle_digest
        waited_s = self._demand.waited_s.get(scene, 0.0)
        told = [holder for holder in self._holders.having(scene) if scene in (holder.desired or ())]
        # What a slow worker needed to load it says nothing of the others.
        load_s = (
            self._costs.typical_load_s if all(h.is_slow for h in told) else self._costs.load_s.get(scene, 0.0)
        )
        if waited_s >= (load_s or self._limits.affinity_wait_s):
            overdue_s = max(OVERDUE * self._costs.usual_load_s(scene), self._limits.affinity_wait_s)
            loading = any(holder.will_have(scene, self._now_s, overdue_s) for holder in told)
            if not loading and not self._demand.idle <= {holder.worker_id for holder in told}:
                self._copies[scene] = len(told) + 1
        return dataclasses.replace(
            need,
            at_least=self._copies.get(scene, 1),
            load_s=self._costs.usual_load_s(scene),
            work_s=need.count * self._costs.execute_s,
            turn=turn,
            share=share,
            render=need.render or scene in self._demand.rendering,
        )

    def _why_not(self, scene: str) -> str:
        announced = {e.bundle_digest for w in self.windows.values() for e in w.entries if e.render}
        renders = scene in announced or scene in self._demand.rendering
        return why_not(self._holders, scene, self._costs.size_mb(scene), renders=renders)

    def _order(self, name: str, scenes: tuple[str, ...]) -> SetDesired | None:
        """Tell the worker, if the set or the order of what it still has to load is another than it was told."""
        holder = self._holders.by_id[name]
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
            run_id = next((run for run, window in self.windows.items() if window.announces(scene)), None)
            if run_id is not None and not self._demand.pending.get(scene):
                self.prewarm.ordered(name, scene, run_id)
        holder.desired = scenes
        self._holders.changed(holder)
        self._holders.fresh.discard(name)
        return SetDesired(name, scenes)
