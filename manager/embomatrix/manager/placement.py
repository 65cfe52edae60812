"""Where scenes should be resident: a pure function of what is needed, when, and how much each worker can hold.

Needs are placed in order of their next use, each where it costs least: on a worker that has it already, else on the one
with the least work. What a worker's memory has no room for is then by construction what is needed last: eviction by
furthest next use (Belady), which is possible here because the trainer says what comes.

A placement looks only at workers that get, have or lose something needed: its cost grows with the needs, not with the cluster.
"""

from __future__ import annotations

import heapq
import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from embomatrix.rpc.values import LookaheadEntry


@dataclass(frozen=True, slots=True)
class Need:
    """A scene, how soon it is needed (0: rollouts wait for it; 1: in the next announced step …) and for how many.

    ``at_least`` workers should have it: more than its share when rollouts wait while slots elsewhere are idle.
    """

    bundle_digest: str
    rank: int
    count: int
    at_least: int = 1


@dataclass(frozen=True, slots=True)
class Site:
    """A worker that can be given scenes. ``residents`` (loading or warm) run from the most to the least recently used.

    ``pinned`` have running rollouts and stay; ``refused`` failed to load there a moment ago.
    """

    worker_id: str
    slots: int
    score: float
    memory_mb: float
    residents: tuple[str, ...] = ()
    pinned: frozenset[str] = frozenset()
    refused: frozenset[str] = frozenset()


class Sites(Protocol):
    """All workers that can be given scenes, looked at one by one."""

    @property
    def ids(self) -> Sequence[str]:
        """Ascending."""
        ...

    @property
    def slots(self) -> int:
        """Of all together."""
        ...

    def site(self, worker_id: str) -> Site:
        """One of them as it is now."""
        ...

    def having(self, scene: str) -> Iterable[str]:
        """Ids of those among whose ``residents`` the scene is."""
        ...

    def changed(self) -> Iterable[str]:
        """Ids of those to look at though nothing needed is there."""
        ...


@dataclass(frozen=True, slots=True)
class Placement:
    """``desired``: what each worker that was looked at should hold, most urgent first; the others keep what they have.

    ``homeless`` are needs for which no worker has room.
    """

    desired: Mapping[str, tuple[str, ...]]
    homeless: tuple[str, ...]


def needs_of(pending: Mapping[str, int], windows: Iterable[Sequence[LookaheadEntry]]) -> list[Need]:
    """Each scene once, at its next use: what rollouts wait for now, then the announced steps of every run in turn."""
    needs = {scene: Need(scene, 0, count) for scene, count in pending.items() if count > 0}
    for entries in windows:
        ranks = {step: 1 + index for index, step in enumerate(sorted({entry.step for entry in entries}))}
        for entry in sorted(entries, key=lambda entry: entry.step):
            rank, known = ranks[entry.step], needs.get(entry.bundle_digest)
            count = max(entry.count, 1)
            if known is None or rank < known.rank:
                needs[entry.bundle_digest] = Need(entry.bundle_digest, rank, count)
            elif rank == known.rank:
                needs[entry.bundle_digest] = Need(entry.bundle_digest, rank, known.count + count)
    return list(needs.values())


class _Shelf:
    """One worker's desired set while it is being filled."""

    def __init__(self, site: Site, size_mb: Callable[[str], float]) -> None:
        self.site = site
        self.chosen: dict[str, None] = {}
        self.work = 0.0
        self.free_mb = site.memory_mb
        self._size_mb = size_mb
        for scene in sorted(site.pinned):
            self.take(scene)

    def has_room_for(self, scene: str) -> bool:
        """The first scene always fits: an estimate shall not keep a small worker from trying."""
        return not self.chosen or self._size_mb(scene) <= self.free_mb

    def accepts(self, scene: str) -> bool:
        return scene not in self.site.refused and self.has_room_for(scene)

    def take(self, scene: str) -> None:
        self.chosen[scene] = None
        self.free_mb -= self._size_mb(scene)

    def keep_the_rest(self) -> None:
        """What nobody needs stays where there is room, the last used first."""
        for scene in self.site.residents:
            if scene not in self.chosen and self.has_room_for(scene):
                self.take(scene)

    @property
    def load(self) -> float:
        """Work per slot, weighed by the worker's speed."""
        return self.work / (self.site.slots * max(self.site.score, 1e-3))

    @property
    def order(self) -> tuple[float, str]:
        return self.load, self.site.worker_id


class _Shelves:
    """Shelves of the workers that were looked at; the rest have no work and are taken in order of their ids."""

    def __init__(self, sites: Sites, size_mb: Callable[[str], float], smallest_mb: float) -> None:
        self._sites = sites
        self._size_mb = size_mb
        self._smallest_mb = smallest_mb
        self._opened: dict[str, _Shelf] = {}
        self._unopened = iter(sites.ids)
        self._queue: list[tuple[float, str]] = []

    def of(self, worker_id: str) -> _Shelf:
        shelf = self._opened.get(worker_id)
        if shelf is None:
            shelf = self._opened[worker_id] = _Shelf(self._sites.site(worker_id), self._size_mb)
            heapq.heappush(self._queue, shelf.order)
        return shelf

    def add_work(self, shelf: _Shelf, work: float) -> None:
        shelf.work += work
        heapq.heappush(self._queue, shelf.order)

    def least_loaded(self, scene: str, count: int) -> list[_Shelf]:
        """Up to ``count`` shelves without the scene that accept it, in order of their load."""
        found: list[_Shelf] = []
        passed: list[tuple[float, str]] = []
        while len(found) < count and (shelf := self._next()) is not None:
            if scene not in shelf.chosen and shelf.accepts(scene):
                found.append(shelf)
            # Who has no room for the smallest has none for any: it need not be looked at again.
            if not shelf.chosen or shelf.free_mb >= self._smallest_mb:
                passed.append(shelf.order)
        for order in passed:
            heapq.heappush(self._queue, order)
        return found

    def close(self) -> dict[str, tuple[str, ...]]:
        for worker_id in sorted(self._sites.changed()):
            self.of(worker_id)
        for shelf in self._opened.values():
            shelf.keep_the_rest()
        return {worker_id: tuple(self._opened[worker_id].chosen) for worker_id in sorted(self._opened)}

    def _next(self) -> _Shelf | None:
        """Take the least loaded out of the queue."""
        while True:
            if not self._queue or self._queue[0][0] > 0.0:
                self._open_one()
            if not self._queue:
                return None
            order = heapq.heappop(self._queue)
            shelf = self._opened[order[1]]
            # An entry from before the shelf got more work has a later one behind it.
            if order == shelf.order:
                return shelf

    def _open_one(self) -> None:
        for worker_id in self._unopened:
            if worker_id not in self._opened:
                self.of(worker_id)
                return


def place(sites: Sites, needs: Sequence[Need], size_mb: Callable[[str], float]) -> Placement:
    """What workers should hold. ``size_mb`` estimates the memory of a scene. Deterministic."""
    smallest_mb = min((size_mb(need.bundle_digest) for need in needs), default=0.0)
    shelves = _Shelves(sites, size_mb, smallest_mb)
    totals: dict[int, int] = {}
    for need in needs:
        totals[need.rank] = totals.get(need.rank, 0) + need.count
    having = {need.bundle_digest: sorted(sites.having(need.bundle_digest)) for need in needs}
    # Among what is needed now, what is resident goes first: evicting it to load another would only cost a load.
    ordered = sorted(needs, key=lambda n: (n.rank, not having[n.bundle_digest], -n.count, n.bundle_digest))
    homeless: list[str] = []
    for rank, group in itertools.groupby(ordered, key=lambda need: need.rank):
        spreads = [
            _Spread(need, _copies(need, sites, totals[rank]), shelves, having[need.bundle_digest])
            for need in group
        ]
        # One copy of each before a second of any: a second shall not push out another's only one.
        for copies_at_most in (1, len(sites.ids)):
            for spread in spreads:
                spread.place(copies_at_most)
        homeless += [spread.need.bundle_digest for spread in spreads if not spread.placed]
    return Placement(shelves.close(), tuple(homeless))


class _Spread:
    """One need on its way to as many workers as it should be on: where it is first, then where there is least to do."""

    def __init__(self, need: Need, copies: int, shelves: _Shelves, having: Sequence[str]) -> None:
        self.need = need
        self.placed: list[_Shelf] = []
        self._copies = copies
        self._shelves = shelves
        self._here = [shelves.of(worker_id) for worker_id in having]

    def place(self, copies_at_most: int) -> None:
        """Add copies until there are as many as it should have, or as are allowed for now."""
        scene, copies = self.need.bundle_digest, min(self._copies, copies_at_most)
        if len(self.placed) >= copies:
            return
        before = len(self.placed)
        # Where rollouts run it stays: that needs no room.
        here = sorted(self._here, key=lambda shelf: (scene not in shelf.chosen, shelf.order))
        for shelf in here:
            if len(self.placed) < copies and shelf not in self.placed:
                if scene not in shelf.chosen:
                    if not shelf.accepts(scene):
                        continue
                    shelf.take(scene)
                self.placed.append(shelf)
        for shelf in self._shelves.least_loaded(scene, copies - len(self.placed)):
            shelf.take(scene)
            self.placed.append(shelf)
        for shelf in self.placed[before:]:
            self._shelves.add_work(shelf, self.need.count / self._copies)


def _copies(need: Need, sites: Sites, total: int) -> int:
    """On how many workers: the scene's share of all slots, no more than its rollouts can keep busy."""
    slots, workers = sites.slots, len(sites.ids)
    if not slots or not total:
        return 1
    slots_each = slots / workers
    share = slots * need.count / total / slots_each
    busy = math.ceil(need.count / slots_each)
    return min(workers, max(1, need.at_least, min(math.ceil(share - 1e-9), busy)))
