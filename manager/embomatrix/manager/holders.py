"""The workers as the Resource-Scheduler sees them: what each holds and was told to hold, found by scene without a search."""

from __future__ import annotations

import bisect
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from embomatrix.rpc.values import Resident, ResidentState, Resources

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from collections.abc import Set as AbstractSet


@dataclass(slots=True, eq=False)
class Holder:
    """A worker. ``residents`` run from the most to the least recently used."""

    worker_id: str
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

    @property
    def slots(self) -> int:
        return max(self.resources.slots, 1)

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
        self.by_id: dict[str, Holder] = {}
        self.usable: list[str] = []
        """Ids of those that can be given scenes, ascending."""
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

    def join(self, worker_id: str, resources: Resources) -> None:
        self.leave(worker_id)
        self.by_id[worker_id] = Holder(worker_id, resources)
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

    def changed(self, holder: Holder) -> None:
        """Bring the indices up to date with it."""
        self._index(holder.worker_id, frozenset(holder.standing()), frozenset(holder.warm_since_s))
        self._use(holder, usable=holder.usable)
        (self.failing.add if holder.failed_s else self.failing.discard)(holder.worker_id)
        if holder.usable:
            self.fresh.add(holder.worker_id)

    def standing_on(self, scene: str) -> AbstractSet[str]:
        """Who has the scene or was told to have it, usable or not."""
        return self._standing_on.get(scene, frozenset())

    def warm_on(self, scene: str) -> AbstractSet[str]:
        """Who reported the scene warm."""
        return self._warm_on.get(scene, frozenset())

    def having(self, scene: str) -> Sequence[Holder]:
        """The usable ones that have the scene or were told to have it."""
        holders = (self.by_id[worker_id] for worker_id in self._standing_on.get(scene, ()))
        return [holder for holder in holders if holder.usable]

    @property
    def least_memory_mb(self) -> int:
        return min(self._memory_mb, default=0)

    @property
    def most_memory_mb(self) -> int:
        return max(self._memory_mb, default=0)

    def _use(self, holder: Holder, *, usable: bool) -> None:
        at = bisect.bisect_left(self.usable, holder.worker_id)
        listed = at < len(self.usable) and self.usable[at] == holder.worker_id
        if usable and not listed:
            self.usable.insert(at, holder.worker_id)
            self.slots += holder.slots
        elif listed and not usable:
            del self.usable[at]
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
