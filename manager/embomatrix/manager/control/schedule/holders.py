"""The workers as the Resource-Scheduler sees them: what each holds and was told to hold, found by scene without a search."""

from __future__ import annotations

import bisect
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from embomatrix.manager.control.schedule.placement import Site
from embomatrix.rpc.wire.values import Resident, ResidentState, Resources

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from collections.abc import Set as AbstractSet

    from embomatrix.manager.control.schedule.placement import Need


@dataclass(slots=True, eq=False)
class SchedulerWorker:
    """A worker. ``residents`` run from the most to the least recently used."""

    worker_id: str
    resources: Resources
    residents: dict[str, Resident] = field(default_factory=dict)
    warm_since_s: dict[str, float] = field(default_factory=dict)
    failed_s: dict[str, float] = field(default_factory=dict)
    failed_words: dict[str, str] = field(default_factory=dict)
    """What it said of each scene that failed there, also when it no longer tells of the scene."""
    desired: tuple[str, ...] | None = None
    reported: bool = False
    suspect: bool = False
    drained: bool = False
    """By an operator."""
    leaving: bool = False
    paused: bool = False
    """It said so itself. While it is paused, what it holds stays."""
    quarantined: bool = False
    """Its results were found to be wrong."""
    score_limit: float = math.inf
    loading_since_s: dict[str, float] = field(default_factory=dict)

    @property
    def usable(self) -> bool:
        return self.reported and not (
            self.suspect or self.drained or self.leaving or self.paused or self.quarantined
        )

    @property
    def renders(self) -> bool:
        """Whether it has slots that render, and the memory for it."""
        return self.resources.render_slots > 0 and self.resources.vram_mb > 0

    @property
    def slots(self) -> int:
        return max(self.resources.slots, 1)

    @property
    def score(self) -> float:
        """Its speed: what it claims, or less where it was found to be slow."""
        return max(min(self.resources.score, self.score_limit), 1e-3)

    @property
    def is_slow(self) -> bool:
        """Plainly slower than others, whatever it claims."""
        return self.score_limit < math.inf

    @property
    def capacity(self) -> float:
        """How many slots of speed 1 it is worth."""
        return self.slots * self.score

    def note(self, resident: Resident, now_s: float) -> None:
        """How far it is with a scene, by its own report."""
        scene = resident.bundle_digest
        if resident.state is not ResidentState.WARM:
            self.warm_since_s.pop(scene, None)
        if resident.state is not ResidentState.LOADING:
            self.loading_since_s.pop(scene, None)
        match resident.state:
            case ResidentState.WARM:
                self.warm_since_s.setdefault(scene, now_s)
                self._forgive(scene)
            case ResidentState.FAILED:
                self.failed_s.setdefault(scene, now_s)
                self.failed_words[scene] = resident.error
            case ResidentState.LOADING:
                self.loading_since_s.setdefault(scene, now_s)
                self._forgive(scene)

    def _forgive(self, scene: str) -> None:
        self.failed_s.pop(scene, None)
        self.failed_words.pop(scene, None)

    def will_have(self, scene: str, now_s: float, overdue_s: float) -> bool:
        """Whether it is worth waiting for this load: the worker is not plainly slow, and the load not overdue."""
        if scene in self.warm_since_s or self.is_slow:
            return False
        return now_s - self.loading_since_s.get(scene, now_s) <= overdue_s

    def standing(self) -> tuple[str, ...]:
        """Scenes that it has or was told to have, by last use. What it was told counts: its reports lag behind."""
        scenes = [
            scene for scene, resident in self.residents.items() if resident.state is not ResidentState.FAILED
        ]
        if self.desired is None:
            return tuple(scenes)
        told = set(self.desired)
        coming = [scene for scene in self.desired if scene not in self.residents]
        kept = [scene for scene in scenes if scene in told]
        return (*kept, *coming, *(scene for scene in scenes if scene not in told))

    def to_load(self, scenes: Iterable[str]) -> list[str]:
        """Those that are not warm here yet, in the same order."""
        return [scene for scene in scenes if scene not in self.warm_since_s]


class Holders:
    """All of them. Whoever changes a holder calls ``changed`` afterwards: the indices follow, and it is looked at again."""

    def __init__(self) -> None:
        self.by_id: dict[str, SchedulerWorker] = {}
        self.order: list[tuple[float, str]] = []
        """The usable ones, which can be given scenes: their capacity below zero and their ids, ascending."""
        self.slots = 0
        """Of the usable ones together."""
        self.fresh: set[str] = set()
        """Usable ones that changed since this was last cleared."""
        self.failing: set[str] = set()
        """Those with a scene that failed to load."""
        self._standing: dict[str, frozenset[str]] = {}
        self._standing_on: dict[str, set[str]] = {}
        self._warm: dict[str, frozenset[str]] = {}
        self._warm_on: dict[str, set[str]] = {}
        self._memory_mb: Counter[int] = Counter()
        self._slow: set[str] = set()

    def join(self, worker_id: str, resources: Resources) -> None:
        self.leave(worker_id)
        self.by_id[worker_id] = SchedulerWorker(worker_id, resources)
        self._memory_mb[resources.memory_mb] += 1

    def leave(self, worker_id: str) -> None:
        holder = self.by_id.pop(worker_id, None)
        if holder is None:
            return
        self._index(worker_id, frozenset(), frozenset())
        self._use(holder, usable=False)
        self.failing.discard(worker_id)
        self._memory_mb[holder.resources.memory_mb] -= 1
        if not self._memory_mb[holder.resources.memory_mb]:
            del self._memory_mb[holder.resources.memory_mb]

    def touch(self, used: Iterable[tuple[str, str]]) -> None:
        """Scenes of these (worker, scene) pairs were just used: they come first, so that of the needless the oldest goes."""
        # Sorted: equal histories shall give equal decisions in every process.
        for worker_id, scene in sorted(used):
            holder = self.by_id.get(worker_id)
            if holder is not None and scene in holder.residents:
                holder.residents = {scene: holder.residents[scene], **holder.residents}

    def speed_of(self, worker_id: str) -> float:
        """Its score, and 1 for one that is gone."""
        holder = self.by_id.get(worker_id)
        return max(holder.resources.score, 1e-3) if holder is not None else 1.0

    def changed(self, holder: SchedulerWorker) -> None:
        """Bring the indices up to date with it."""
        self._index(holder.worker_id, frozenset(holder.standing()), frozenset(holder.warm_since_s))
        self._use(holder, usable=holder.usable)
        (self.failing.add if holder.failed_s else self.failing.discard)(holder.worker_id)
        if holder.usable:
            self.fresh.add(holder.worker_id)

    def limit_scores(self, lags: Mapping[str, float]) -> None:
        """These workers are so many times slower than others, whatever they claim; the rest are what they claim."""
        usual = sum(holder.resources.score for holder in self.by_id.values()) / max(len(self.by_id), 1)
        for worker_id in lags.keys() | self._slow:
            holder = self.by_id.get(worker_id)
            if holder is None:
                self._slow.discard(worker_id)
                continue
            # In halves: a capacity that moves with every result would move scenes.
            limit = usual / 2.0 ** round(math.log2(lags[worker_id])) if worker_id in lags else math.inf
            if limit != holder.score_limit:
                self._use(holder, usable=False)
                holder.score_limit = limit
                (self._slow.discard if limit == math.inf else self._slow.add)(worker_id)
                self.changed(holder)

    def standing_on(self, scene: str) -> AbstractSet[str]:
        """Who has the scene or was told to have it, usable or not."""
        return self._standing_on.get(scene, frozenset())

    def warm_on(self, scene: str) -> AbstractSet[str]:
        """Who reported the scene warm."""
        return self._warm_on.get(scene, frozenset())

    def having(self, scene: str) -> Sequence[SchedulerWorker]:
        """The usable ones that have the scene or were told to have it."""
        holders = (self.by_id[worker_id] for worker_id in self._standing_on.get(scene, ()))
        return [holder for holder in holders if holder.usable]

    @property
    def least_memory_mb(self) -> int:
        return min(self._memory_mb, default=0)

    @property
    def most_memory_mb(self) -> int:
        return max(self._memory_mb, default=0)

    def _use(self, holder: SchedulerWorker, *, usable: bool) -> None:
        key = (-holder.capacity, holder.worker_id)
        at = bisect.bisect_left(self.order, key)
        listed = at < len(self.order) and self.order[at] == key
        if usable and not listed:
            self.order.insert(at, key)
            self.slots += holder.slots
        elif listed and not usable:
            del self.order[at]
            self.slots -= holder.slots
        if not usable:
            self.fresh.discard(holder.worker_id)

    def _index(self, worker_id: str, standing: frozenset[str], warm: frozenset[str]) -> None:
        for scenes, of, on in (
            (standing, self._standing, self._standing_on),
            (warm, self._warm, self._warm_on),
        ):
            before = of.get(worker_id, frozenset())
            for scene in before - scenes:
                on[scene].discard(worker_id)
                if not on[scene]:
                    del on[scene]
            for scene in scenes - before:
                on.setdefault(scene, set()).add(worker_id)
            if scenes:
                of[worker_id] = scenes
            else:
                of.pop(worker_id, None)


class Places:
    """The holders as a placement wants to see them, at one moment."""

    def __init__(
        self, holders: Holders, now_s: float, in_use: frozenset[tuple[str, str]], retry_s: float
    ) -> None:
        self._holders = holders
        self._now_s = now_s
        self._in_use = in_use
        self._retry_s = retry_s
        self._large: list[tuple[str, float]] = []
        self._rendering: frozenset[str] = frozenset()

    def refuse_where_too_large(self, needs: Iterable[Need], size_mb: Mapping[str, float]) -> None:
        """Scenes that were measured and found larger than all the memory of a worker are not tried there again."""
        least_mb = self._holders.least_memory_mb
        sizes = ((need.bundle_digest, size_mb.get(need.bundle_digest, 0.0)) for need in needs)
        self._large = [(scene, size) for scene, size in sizes if size > least_mb]

    def refuse_where_nothing_renders(self, needs: Iterable[Need]) -> None:
        """Scenes whose rollouts render go to workers that can."""
        self._rendering = frozenset(need.bundle_digest for need in needs if need.render)

    @property
    def ids(self) -> Iterable[str]:
        return (worker_id for _, worker_id in self._holders.order)

    @property
    def slots(self) -> int:
        return self._holders.slots

    def site(self, worker_id: str) -> Site:
        holder = self._holders.by_id[worker_id]
        memory_mb = holder.resources.memory_mb
        held = holder.standing()
        return Site(
            worker_id=worker_id,
            slots=holder.slots,
            score=holder.score,
            memory_mb=memory_mb,
            residents=held,
            pinned=frozenset(scene for scene in held if (worker_id, scene) in self._in_use),
            refused=self.refused(holder),
        )

    def refused(self, holder: SchedulerWorker) -> frozenset[str]:
        """What failed to load there a moment ago, what can't fit, and what needs a GPU or a version that is not there."""
        failed = {scene for scene, at_s in holder.failed_s.items() if self._now_s - at_s < self._retry_s}
        failed.update(scene for scene, size in self._large if size > holder.resources.memory_mb)
        if self._rendering and not holder.renders:
            failed.update(self._rendering)
        return frozenset(failed)

    def having(self, scene: str) -> Iterable[str]:
        return [holder.worker_id for holder in self._holders.having(scene)]

    def changed(self) -> Iterable[str]:
        by_id = self._holders.by_id
        return self._holders.fresh | {name for name in self._holders.failing if by_id[name].usable}

    def nobody_takes(self, scene: str) -> bool:
        """Whether every usable worker refuses the scene."""
        workers = (self._holders.by_id[worker_id] for worker_id in self.ids)
        return bool(self._holders.order) and all(scene in self.refused(holder) for holder in workers)
