"""Placement of scenes on workers: a pure function of the needs, their times, and the memory of each worker.

Needs are placed in order of their next use, each on a worker that has the scene, else on the least loaded one. A worker
without room therefore evicts the scene with the furthest next use (Belady's rule), which the trainers' look-ahead makes
possible. Runs share memory and slots by priority, then weight; what one run leaves unused is free for the others.

A placement examines only workers that get, have or lose a needed scene: its cost grows with the needs, not the cluster.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import math
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

from embomatrix.rpc.wire.values import LookaheadEntry


@dataclass(frozen=True, slots=True)
class RunShare:
    """A run's claim against other runs."""

    run_id: str = ""
    weight: float = 1.0
    priority: int = 0


def in_turns(needs: Iterable[Need], cost: Callable[[Need], float]) -> list[Need]:
    """Sort needs by rank, then priority, then the cost over weight that their run has by then.

    Needs of one run keep their order, and needs of equal runs alternate, however many each run has.
    """
    spent: dict[str, float] = {}
    keyed: list[tuple[int, int, float, int, Need]] = []
    for index, need in enumerate(needs):
        share = need.share
        spent[share.run_id] = spent.get(share.run_id, 0.0) + cost(need) / share.weight
        keyed.append((need.rank, -share.priority, spent[share.run_id], index, need))
    return [need for *_, need in sorted(keyed, key=lambda entry: entry[:4])]


def quotas(wanted: Mapping[RunShare, int], slots: int) -> dict[RunShare, float]:
    """Return each run's quota of slots: shared by weight, higher priority first, no run beyond what it wants."""
    left = float(slots)
    given: dict[RunShare, float] = {}
    for priority in sorted({share.priority for share in wanted}, reverse=True):
        equals = [share for share in wanted if share.priority == priority]
        # Runs that want least for their weight are served in full; the others share the rest.
        equals.sort(key=lambda share: (wanted[share] / share.weight, share.run_id))
        # Summed from the end: subtracting a large weight from a sum loses the small ones.
        weights = [*itertools.accumulate(share.weight for share in reversed(equals))]
        for share, weight in zip(equals, reversed(weights), strict=True):
            given[share] = min(float(wanted[share]), left * share.weight / weight)
            left -= given[share]
    return given


EVERYONE: Final = RunShare()
MOST_SCENES: Final = 1_024
"""Most scenes that a worker is ordered to hold. Those with live leases stay beyond it."""


@dataclass(frozen=True, slots=True)
class Need:
    """A scene that ``count`` rollouts need."""

    bundle_digest: str
    rank: int
    """0: rollouts wait for it now; n: the n-th announced step needs it."""
    count: int
    at_least: int = 1
    """Smallest number of copies, whatever its share of the slots."""
    load_s: float = 0.0
    """Load time; 0 if unknown."""
    work_s: float = 0.0
    """Execution time of its rollouts on one slot of speed 1; 0 if unknown."""
    turn: int = 0
    """Queue position of its first rollout: re-dispatched rollouts come before later ones."""
    share: RunShare = EVERYONE
    render: bool = False
    """Some of its rollouts need slots that render."""


@dataclass(frozen=True, slots=True)
class Site:
    """A usable worker."""

    worker_id: str
    slots: int
    score: float
    memory_mb: float
    residents: tuple[str, ...] = ()
    """Loading or warm scenes, from the most to the least recently used."""
    pinned: frozenset[str] = frozenset()
    """Scenes with live leases, which stay."""
    refused: frozenset[str] = frozenset()
    """Scenes that the worker cannot hold."""
    measured_mb: Mapping[str, float] = field(default_factory=dict)
    """Memory of scenes as the worker itself measured it."""

    @property
    def capacity(self) -> float:
        """Its slots, in slots of speed 1."""
        return self.slots * max(self.score, 1e-3)


class Sites(Protocol):
    """All usable workers, examined one by one."""

    @property
    def ids(self) -> Iterable[str]:
        """Ids, largest capacity first."""
        ...

    @property
    def slots(self) -> int:
        """Number of slots of all workers."""
        ...

    def site(self, worker_id: str) -> Site:
        """Return one worker in its present state."""
        ...

    def having(self, scene: str) -> Iterable[str]:
        """Return the ids of workers with the scene among their ``residents``."""
        ...

    def changed(self) -> Iterable[str]:
        """Return the ids of workers to examine even if they have no needed scene."""
        ...


@dataclass(frozen=True, slots=True)
class ResidencyPlan:
    """Result of a placement."""

    desired: Mapping[str, tuple[str, ...]]
    """Scenes of each examined worker, most urgent first; the other workers keep theirs."""
    unplaced: tuple[str, ...]
    """Needed scenes that no worker has room for."""


def needs_of(pending: Mapping[str, int], windows: Iterable[Sequence[LookaheadEntry]]) -> list[Need]:
    """Return each scene once, at its next use: pending rollouts first, then the announced steps of all runs."""
    needs = {scene: Need(scene, 0, count) for scene, count in pending.items() if count > 0}
    for entries in windows:
        ranks = {step: 1 + index for index, step in enumerate(sorted({entry.step for entry in entries}))}
        for entry in sorted(entries, key=lambda entry: entry.step):
            rank, known = ranks[entry.step], needs.get(entry.bundle_digest)
            count = max(entry.count, 1)
            if known is None or rank < known.rank:
                needs[entry.bundle_digest] = Need(entry.bundle_digest, rank, count, render=entry.render)
            elif rank == known.rank:
                render = known.render or entry.render
                needs[entry.bundle_digest] = Need(
                    entry.bundle_digest, rank, known.count + count, render=render
                )
    return list(needs.values())


class _WorkerPlan:
    """Desired set of one worker while it is filled."""

    def __init__(self, site: Site, size_mb: Callable[[str], float]) -> None:
        self.site = site
        self.chosen: dict[str, None] = {}
        self.work = 0.0
        self.free_mb = site.memory_mb
        self._size_mb = size_mb
        for scene in sorted(site.pinned):
            self.take(scene)

    def has_room_for(self, scene: str) -> bool:
        """True if the scene fits. The first always fits, so that an estimate keeps no small worker from trying."""
        return not self.chosen or (len(self.chosen) < MOST_SCENES and self._size(scene) <= self.free_mb)

    def accepts(self, scene: str) -> bool:
        return scene not in self.site.refused and self.has_room_for(scene)

    def take(self, scene: str) -> None:
        self.chosen[scene] = None
        self.free_mb -= self._size(scene)

    def _size(self, scene: str) -> float:
        return self.site.measured_mb.get(scene) or self._size_mb(scene)

    def keep_the_rest(self) -> None:
        """Keep unneeded residents while there is room, the last used first."""
        for scene in self.site.residents:
            if scene not in self.chosen and self.has_room_for(scene):
                self.take(scene)

    def order(self, unit: float) -> tuple[float, str]:
        """Return the sort key: work per slot of speed 1 after ``unit`` more, so small workers fill up sooner."""
        return (self.work + unit) / self.site.capacity, self.site.worker_id


class _WorkerPlans:
    """Plans of the examined workers. The others have no work and follow in order of capacity."""

    def __init__(self, sites: Sites, needs: Sequence[Need], size_mb: Callable[[str], float]) -> None:
        self._sites = sites
        self._size_mb = size_mb
        self._smallest_mb = min((size_mb(need.bundle_digest) for need in needs), default=0.0)
        self._unit = sum(need.count for need in needs) / max(len(needs), 1)
        self._opened: dict[str, _WorkerPlan] = {}
        self._unopened = iter(sites.ids)
        self._queue: list[tuple[float, str]] = []
        self._border = ""
        self._open_next_worker()

    def of(self, worker_id: str) -> _WorkerPlan:
        plan = self._opened.get(worker_id)
        if plan is None:
            plan = self._opened[worker_id] = _WorkerPlan(self._sites.site(worker_id), self._size_mb)
            heapq.heappush(self._queue, plan.order(self._unit))
        return plan

    def add_work(self, plan: _WorkerPlan, work: float) -> None:
        plan.work += work
        heapq.heappush(self._queue, plan.order(self._unit))

    def in_order(self, plans: Iterable[_WorkerPlan]) -> list[_WorkerPlan]:
        return sorted(plans, key=lambda plan: plan.order(self._unit))

    def accepting(self, scene: str) -> Generator[_WorkerPlan]:
        """Yield plans without the scene that accept it, least loaded first. Close the generator after the last."""
        passed: list[tuple[float, str]] = []
        try:
            while (plan := self._next()) is not None:
                # A worker without room for the smallest scene is never examined again.
                if not plan.chosen or plan.free_mb >= self._smallest_mb:
                    passed.append(plan.order(self._unit))
                if scene not in plan.chosen and plan.accepts(scene):
                    yield plan
        finally:
            for order in passed:
                heapq.heappush(self._queue, order)

    def close(self) -> dict[str, tuple[str, ...]]:
        for worker_id in sorted(self._sites.changed()):
            self.of(worker_id)
        for plan in self._opened.values():
            plan.keep_the_rest()
        return {worker_id: tuple(self._opened[worker_id].chosen) for worker_id in sorted(self._opened)}

    def _next(self) -> _WorkerPlan | None:
        """Pop the plan of the least loaded worker."""
        while self._queue:
            order = heapq.heappop(self._queue)
            if order[1] == self._border:
                self._open_next_worker()
            plan = self._opened[order[1]]
            # Entries from before the plan got more work are stale.
            if order == plan.order(self._unit):
                return plan
        return None

    def _open_next_worker(self) -> None:
        """Open the next worker without work; every other one sorts after it."""
        self._border = next((name for name in self._unopened if name not in self._opened), "")
        if self._border:
            self.of(self._border)


def place(sites: Sites, needs: Sequence[Need], size_mb: Callable[[str], float]) -> ResidencyPlan:
    """Compute the desired sets. ``size_mb`` estimates the memory of a scene. Deterministic."""
    plans = _WorkerPlans(sites, needs, size_mb)
    wanted = _SlotsWanted(needs, sites.slots)
    having = {need.bundle_digest: sorted(sites.having(need.bundle_digest)) for need in needs}
    # Of equal rank, resident scenes go first: evicting one to load another only costs a load.
    ordered = sorted(
        needs, key=lambda n: (n.rank, not having[n.bundle_digest], n.turn, -n.count, n.bundle_digest)
    )
    ordered = in_turns(ordered, lambda need: size_mb(need.bundle_digest))
    unplaced: list[str] = []
    for _, group in itertools.groupby(ordered, key=lambda need: need.rank):
        spreads = [
            _ReplicaPlacement(need, wanted.of(need), plans, having[need.bundle_digest]) for need in group
        ]
        # A first copy of each before a second of any: no second copy displaces another scene's only one.
        for spread in spreads:
            spread.place_one()
        for spread in spreads:
            spread.place_more()
        unplaced += [spread.need.bundle_digest for spread in spreads if not spread.placed]
    return ResidencyPlan(plans.close(), tuple(unplaced))


class _SlotsWanted:
    """Slots wanted for each need: its part of its run's quota, at most one per rollout."""

    def __init__(self, needs: Sequence[Need], slots: int) -> None:
        self._totals: dict[int, Counter[RunShare]] = {}
        for need in needs:
            self._totals.setdefault(need.rank, Counter())[need.share] += need.count
        # Groups of a step arrive one by one: those present share the slots with the next ones.
        if 0 in self._totals:
            self._totals[0] += self._totals.get(1, Counter())
        self._quotas = {rank: quotas(totals, slots) for rank, totals in self._totals.items()}

    def of(self, need: Need) -> int:
        total = self._totals[need.rank][need.share]
        part = self._quotas[need.rank][need.share] * need.count / total
        return min(need.count, math.ceil(part - 1e-9))


class _ReplicaPlacement:
    """Placement of one need: first on workers that have the scene, then on the least loaded ones."""

    def __init__(self, need: Need, slots: int, plans: _WorkerPlans, having: Sequence[str]) -> None:
        self.need = need
        self.placed: list[_WorkerPlan] = []
        self._slots = slots
        self._plans = plans
        self._here = [plans.of(worker_id) for worker_id in having]

    def place_one(self) -> None:
        """Place one copy, with all the work."""
        scene = self.need.bundle_digest
        # Pinned copies stay and need no room.
        here = sorted(self._plans.in_order(self._here), key=lambda plan: scene not in plan.chosen)
        for plan in here:
            if scene in plan.chosen or plan.accepts(scene):
                self._put(plan)
                break
        else:
            self._put_on_others(one=True)
        if self.placed:
            self._plans.add_work(self.placed[0], self.need.count)

    def place_more(self) -> None:
        """Place more copies while they pay off, and share the work among all."""
        if not self.placed or not self._wants_more():
            return
        scene = self.need.bundle_digest
        for plan in self._plans.in_order(self._here):
            if plan in self.placed or not self._wants_more():
                continue
            if scene in plan.chosen or plan.accepts(scene):
                self._put(plan)
        if self._wants_more():
            self._put_on_others(one=False)
        capacity = self._capacity()
        self._plans.add_work(self.placed[0], -self.need.count)
        for plan in self.placed:
            self._plans.add_work(plan, self.need.count * plan.site.capacity / capacity)

    def _put_on_others(self, *, one: bool) -> None:
        with contextlib.closing(self._plans.accepting(self.need.bundle_digest)) as others:
            for plan in others:
                self._put(plan)
                if one or not self._wants_more():
                    break

    def _put(self, plan: _WorkerPlan) -> None:
        if self.need.bundle_digest not in plan.chosen:
            plan.take(self.need.bundle_digest)
        self.placed.append(plan)

    def _wants_more(self) -> bool:
        """True if one more copy has slots to use and would load before the others finish the work."""
        if len(self.placed) < self.need.at_least:
            return True
        if sum(plan.site.slots for plan in self.placed) >= self._slots:
            return False
        known = self.need.load_s and self.need.work_s
        return not known or self.need.work_s / self._capacity() > self.need.load_s

    def _capacity(self) -> float:
        return sum(plan.site.capacity for plan in self.placed)
