"""Residency of scenes on workers: the held and the desired scenes of each worker, indexed by scene."""

import bisect
import math
from collections import Counter
from collections.abc import Iterable, Mapping, MutableMapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Final, TypeVar

from embomatrix.manager.control.schedule.placement import Need, Site
from embomatrix.manager.control.workers import WorkerRecord
from embomatrix.rpc.wire.values import Resident, ResidentState

T = TypeVar("T")
KEPT_SCENES: Final = 1_024
"""Scenes of a worker whose measurements and failures are kept after it stops reporting them."""


def keep_newest(entries: MutableMapping[str, T], most: int) -> None:
    """Drop the entries that were added first, until so many are left."""
    while len(entries) > most:
        del entries[next(iter(entries))]


@dataclass(slots=True, eq=False)
class WorkerResidency:
    """Scenes of one worker. Its standing and resources are read from ``worker``."""

    worker: WorkerRecord
    residents: dict[str, Resident] = field(default_factory=dict)
    """Scenes from the most to the least recently used."""
    warm_since_s: dict[str, float] = field(default_factory=dict)
    loading_since_s: dict[str, float] = field(default_factory=dict)
    failed_s: dict[str, float] = field(default_factory=dict)
    failure_messages: dict[str, str] = field(default_factory=dict)
    """Message of each scene that failed to load, kept after the worker stops reporting the scene."""
    measured_mb: dict[str, float] = field(default_factory=dict)
    """Largest memory of each scene that the worker reported."""
    too_large: set[str] = field(default_factory=set)
    """Scenes of ``measured_mb`` beyond its memory. A size that others report keeps no worker from trying."""
    desired: tuple[str, ...] | None = None
    """The last desired set; None if the worker may not have received it."""
    score_limit: float = math.inf
    listed: bool = False
    """True while the worker is in ``Residencies.order``."""

    @property
    def worker_id(self) -> str:
        return self.worker.worker_id

    @property
    def renders(self) -> bool:
        """True if it has slots that render, and the memory for it."""
        return self.worker.resources.render_slots > 0 and self.worker.resources.vram_mb > 0

    @property
    def score(self) -> float:
        """Claimed speed, or less if it was measured as slow."""
        return max(min(self.worker.resources.score, self.score_limit), 1e-3)

    @property
    def is_slow(self) -> bool:
        """True if it was measured as plainly slower than others."""
        return self.score_limit < math.inf

    @property
    def capacity(self) -> float:
        """Its slots, in slots of speed 1."""
        return self.worker.slots * self.score

    def note(self, resident: Resident, now_s: float) -> None:
        """Record the reported state of a scene."""
        scene = resident.bundle_digest
        self._measure(scene, resident.memory_mb)
        if resident.state is not ResidentState.WARM:
            self.warm_since_s.pop(scene, None)
        if resident.state is not ResidentState.LOADING:
            self.loading_since_s.pop(scene, None)
        if resident.state is ResidentState.FAILED:
            self.failed_s.setdefault(scene, now_s)
            self.failure_messages[scene] = resident.error
            keep_newest(self.failed_s, KEPT_SCENES)
            keep_newest(self.failure_messages, KEPT_SCENES)
            return
        since_s = self.warm_since_s if resident.state is ResidentState.WARM else self.loading_since_s
        since_s.setdefault(scene, now_s)
        self.failed_s.pop(scene, None)
        self.failure_messages.pop(scene, None)

    def _measure(self, scene: str, memory_mb: float) -> None:
        if memory_mb <= self.measured_mb.get(scene, 0.0):
            return
        self.measured_mb[scene] = memory_mb
        keep_newest(self.measured_mb, KEPT_SCENES)
        if memory_mb > self.worker.resources.memory_mb:
            self.too_large.add(scene)
        self.too_large &= self.measured_mb.keys()

    def loads_in_time(self, scene: str, now_s: float, overdue_s: float) -> bool:
        """True if the worker is loading the scene, is not slow, and the load is not overdue."""
        if scene in self.warm_since_s or self.is_slow:
            return False
        return now_s - self.loading_since_s.get(scene, now_s) <= overdue_s

    def assigned(self) -> tuple[str, ...]:
        """Return the held and the desired scenes, by last use. Reports lag behind orders, so both count."""
        scenes = [
            scene for scene, resident in self.residents.items() if resident.state is not ResidentState.FAILED
        ]
        if self.desired is None:
            return tuple(scenes)
        desired = set(self.desired)
        coming = [scene for scene in self.desired if scene not in self.residents]
        kept = [scene for scene in scenes if scene in desired]
        return (*kept, *coming, *(scene for scene in scenes if scene not in desired))

    def to_load(self, scenes: Iterable[str]) -> list[str]:
        """Return the scenes that are not warm here, in the same order."""
        return [scene for scene in scenes if scene not in self.warm_since_s]


class Residencies:
    """All workers. Call ``changed`` after each change of a residency or of its worker's standing."""

    def __init__(self) -> None:
        self.by_id: dict[str, WorkerResidency] = {}
        self.order: list[tuple[float, str]] = []
        """Usable workers as (-capacity, id), ascending."""
        self.slots = 0
        """Slots of the workers in ``order``."""
        self.fresh: set[str] = set()
        """Usable workers that changed since the last placement."""
        self.failing: set[str] = set()
        """Workers with ``failed_s``."""
        self._assigned: dict[str, frozenset[str]] = {}
        self._assigned_on: dict[str, set[str]] = {}
        """Inverse of ``_assigned``; no empty entries."""
        self._memory_mb: Counter[int] = Counter()
        self._slow: set[str] = set()

    def join(self, worker: WorkerRecord) -> None:
        self.leave(worker.worker_id)
        self.by_id[worker.worker_id] = WorkerResidency(worker)
        self._memory_mb[worker.resources.memory_mb] += 1

    def leave(self, worker_id: str) -> None:
        residency = self.by_id.pop(worker_id, None)
        if residency is None:
            return
        self._index(worker_id, frozenset())
        self._list(residency, usable=False)
        self.failing.discard(worker_id)
        memory_mb = residency.worker.resources.memory_mb
        self._memory_mb[memory_mb] -= 1
        if not self._memory_mb[memory_mb]:
            del self._memory_mb[memory_mb]

    def touch(self, used: Iterable[tuple[str, str]]) -> None:
        """Mark the scenes of (worker, scene) pairs as most recently used."""
        # Sorted: equal histories give equal decisions in every process.
        for worker_id, scene in sorted(used):
            residency = self.by_id.get(worker_id)
            if residency is not None and scene in residency.residents:
                residency.residents = {scene: residency.residents[scene], **residency.residents}

    def speed_of(self, worker_id: str) -> float:
        """Return the worker's claimed score; 1 if it is gone."""
        residency = self.by_id.get(worker_id)
        return max(residency.worker.resources.score, 1e-3) if residency is not None else 1.0

    def changed(self, residency: WorkerResidency) -> None:
        """Bring the indices up to date."""
        worker_id, usable = residency.worker_id, residency.worker.usable
        self._index(worker_id, frozenset(residency.assigned()))
        self._list(residency, usable=usable)
        (self.failing.add if residency.failed_s else self.failing.discard)(worker_id)
        if usable:
            self.fresh.add(worker_id)

    def limit_scores(self, lags: Mapping[str, float]) -> None:
        """Limit the scores of slow workers by their measured slowdown; the others count as they claim."""
        usual = sum(r.worker.resources.score for r in self.by_id.values()) / max(len(self.by_id), 1)
        for worker_id in lags.keys() | self._slow:
            residency = self.by_id.get(worker_id)
            if residency is None:
                self._slow.discard(worker_id)
                continue
            # In powers of two: a capacity that changes with every result would move scenes.
            limit = usual / 2.0 ** round(math.log2(lags[worker_id])) if worker_id in lags else math.inf
            if limit != residency.score_limit:
                self._list(residency, usable=False)
                residency.score_limit = limit
                (self._slow.discard if limit == math.inf else self._slow.add)(worker_id)
                self.changed(residency)

    def assigned_on(self, scene: str) -> AbstractSet[str]:
        """Return the workers, usable or not, that have the scene or were ordered to load it."""
        return self._assigned_on.get(scene, frozenset())

    def warm_since_s(self, scene: str) -> float | None:
        """Return the time since which the first of the present workers has the scene warm; None if none has it."""
        times = (self.by_id[worker_id].warm_since_s.get(scene) for worker_id in self.assigned_on(scene))
        return min((at_s for at_s in times if at_s is not None), default=None)

    def having(self, scene: str) -> Sequence[WorkerResidency]:
        """Return the usable workers that have the scene or were ordered to load it."""
        residencies = (self.by_id[worker_id] for worker_id in self._assigned_on.get(scene, ()))
        return [residency for residency in residencies if residency.worker.usable]

    @property
    def most_memory_mb(self) -> int:
        return max(self._memory_mb, default=0)

    def _list(self, residency: WorkerResidency, *, usable: bool) -> None:
        """Have ``order`` and ``slots`` contain the worker if it is usable. Its capacity must be that of the last call."""
        key = (-residency.capacity, residency.worker_id)
        if usable and not residency.listed:
            bisect.insort(self.order, key)
            self.slots += residency.worker.slots
        elif residency.listed and not usable:
            del self.order[bisect.bisect_left(self.order, key)]
            self.slots -= residency.worker.slots
        residency.listed = usable
        if not usable:
            self.fresh.discard(residency.worker_id)

    def _index(self, worker_id: str, scenes: frozenset[str]) -> None:
        before = self._assigned.pop(worker_id, frozenset())
        for scene in before - scenes:
            self._assigned_on[scene].discard(worker_id)
            if not self._assigned_on[scene]:
                del self._assigned_on[scene]
        for scene in scenes - before:
            self._assigned_on.setdefault(scene, set()).add(worker_id)
        if scenes:
            self._assigned[worker_id] = scenes


class ResidencySites:
    """The workers as sites of one placement. A worker refuses scenes that it cannot use or that failed there lately."""

    def __init__(
        self,
        residencies: Residencies,
        now_s: float,
        in_use: frozenset[tuple[str, str]],
        retry_s: float,
        *,
        needs: Sequence[Need],
    ) -> None:
        self._residencies = residencies
        self._now_s = now_s
        self._in_use = in_use
        self._retry_s = retry_s
        self._rendering = frozenset(need.bundle_digest for need in needs if need.render)
        self._refused: dict[str, frozenset[str]] = {}

    @property
    def ids(self) -> Iterable[str]:
        return (worker_id for _, worker_id in self._residencies.order)

    @property
    def slots(self) -> int:
        return self._residencies.slots

    def site(self, worker_id: str) -> Site:
        residency = self._residencies.by_id[worker_id]
        assigned = residency.assigned()
        return Site(
            worker_id=worker_id,
            slots=residency.worker.slots,
            score=residency.score,
            memory_mb=residency.worker.resources.memory_mb,
            residents=assigned,
            pinned=frozenset(scene for scene in assigned if (worker_id, scene) in self._in_use),
            refused=self.refused(residency),
            measured_mb=residency.measured_mb,
        )

    def refused(self, residency: WorkerResidency) -> frozenset[str]:
        """Return the scenes that recently failed there, that it measured as too large, or that need a GPU."""
        known = self._refused.get(residency.worker_id)
        if known is None:
            known = self._refused[residency.worker_id] = frozenset(self._refusals(residency))
        return known

    def _refusals(self, residency: WorkerResidency) -> set[str]:
        refused = {scene for scene, at_s in residency.failed_s.items() if self._now_s - at_s < self._retry_s}
        refused.update(residency.too_large)
        if self._rendering and not residency.renders:
            refused.update(self._rendering)
        return refused

    def having(self, scene: str) -> Iterable[str]:
        return [residency.worker_id for residency in self._residencies.having(scene)]

    def changed(self) -> Iterable[str]:
        by_id = self._residencies.by_id
        failing = {name for name in self._residencies.failing if by_id[name].worker.usable}
        return self._residencies.fresh | failing

    def all_refuse(self, scene: str) -> bool:
        """True if there are usable workers and all of them refuse the scene."""
        residencies = (self._residencies.by_id[worker_id] for worker_id in self.ids)
        return bool(self._residencies.order) and all(scene in self.refused(r) for r in residencies)
