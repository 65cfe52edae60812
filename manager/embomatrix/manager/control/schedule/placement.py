"""Where scenes should be resident: a pure function of what is needed, when, and how much each worker can hold.

Needs are placed in order of their next use, each where it costs least: on a worker that has it already, else on the one
with the least work. What a worker's memory has no room for is then by construction what is needed last: eviction by
furthest next use (Belady), which is possible here because the trainer says what comes.

A placement looks only at workers that get, have or lose something needed: its cost grows with the needs, not with the cluster.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from embomatrix.manager.control.shares import RunShare, in_turns, quotas

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Mapping, Sequence

    from embomatrix.rpc.wire.values import LookaheadEntry


EVERYONE: Final = RunShare()


@dataclass(frozen=True, slots=True)
class Need:
    """A scene, how soon it is needed (0: rollouts wait for it; 1: in the next announced step …) and for how many.

    ``at_least`` workers should have it: more than its share when rollouts wait while slots elsewhere are idle. Where they are
    known, ``load_s`` is what loading it takes and ``work_s`` what its rollouts take on one slot of speed 1. ``turn`` is
    the place of its first rollout in the queue: what a lost worker left behind comes before what was sent after it.
    """

    bundle_digest: str
    rank: int
    count: int
    at_least: int = 1
    load_s: float = 0.0
    work_s: float = 0.0
    turn: int = 0
    share: RunShare = EVERYONE
    """Of the run that needs it."""
    render: bool = False
    """Some of its rollouts need slots that render."""


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

    @property
    def capacity(self) -> float:
        """How many slots of speed 1 it is worth."""
        return self.slots * max(self.score, 1e-3)


class Sites(Protocol):
    """All workers that can be given scenes, looked at one by one."""

    @property
    def ids(self) -> Iterable[str]:
        """Those with the most capacity first."""
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
class ResidencyPlan:
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
                needs[entry.bundle_digest] = Need(entry.bundle_digest, rank, count, render=entry.render)
            elif rank == known.rank:
                render = known.render or entry.render
                needs[entry.bundle_digest] = Need(
                    entry.bundle_digest, rank, known.count + count, render=render
                )
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

    def order(self, unit: float) -> tuple[float, str]:
        """By the work for each slot of speed 1 that there would be with ``unit`` more: a small worker is full sooner."""
        return (self.work + unit) / self.site.capacity, self.site.worker_id


class _Shelves:
    """Shelves of the workers that were looked at; the rest have no work, and wait in the order of their capacity."""

    def __init__(self, sites: Sites, needs: Sequence[Need], size_mb: Callable[[str], float]) -> None:
        self._sites = sites
        self._size_mb = size_mb
        self._smallest_mb = min((size_mb(need.bundle_digest) for need in needs), default=0.0)
        self._unit = sum(need.count for need in needs) / max(len(needs), 1)
        self._opened: dict[str, _Shelf] = {}
        self._unopened = iter(sites.ids)
        self._queue: list[tuple[float, str]] = []
        self._border = ""
        self._move_border()

    def of(self, worker_id: str) -> _Shelf:
        shelf = self._opened.get(worker_id)
        if shelf is None:
            shelf = self._opened[worker_id] = _Shelf(self._sites.site(worker_id), self._size_mb)
            heapq.heappush(self._queue, shelf.order(self._unit))
        return shelf

    def add_work(self, shelf: _Shelf, work: float) -> None:
        shelf.work += work
        heapq.heappush(self._queue, shelf.order(self._unit))

    def in_order(self, shelves: Iterable[_Shelf]) -> list[_Shelf]:
        return sorted(shelves, key=lambda shelf: shelf.order(self._unit))

    def accepting(self, scene: str) -> Generator[_Shelf]:
        """Shelves without the scene that accept it, the least loaded first. To be closed when there are enough."""
        passed: list[tuple[float, str]] = []
        try:
            while (shelf := self._next()) is not None:
                # Who has no room for the smallest has none for any: it need not be looked at again.
                if not shelf.chosen or shelf.free_mb >= self._smallest_mb:
                    passed.append(shelf.order(self._unit))
                if scene not in shelf.chosen and shelf.accepts(scene):
                    yield shelf
        finally:
            for order in passed:
                heapq.heappush(self._queue, order)

    def close(self) -> dict[str, tuple[str, ...]]:
        for worker_id in sorted(self._sites.changed()):
            self.of(worker_id)
        for shelf in self._opened.values():
            shelf.keep_the_rest()
        return {worker_id: tuple(self._opened[worker_id].chosen) for worker_id in sorted(self._opened)}

    def _next(self) -> _Shelf | None:
        """Take the least loaded out of the queue."""
        while self._queue:
            order = heapq.heappop(self._queue)
            if order[1] == self._border:
                self._move_border()
            shelf = self._opened[order[1]]
            # An entry from before the shelf got more work has a later one behind it.
            if order == shelf.order(self._unit):
                return shelf
        return None

    def _move_border(self) -> None:
        """Open the next of those without work: none of the others comes before it in the queue."""
        self._border = next((name for name in self._unopened if name not in self._opened), "")
        if self._border:
            self.of(self._border)


def place(sites: Sites, needs: Sequence[Need], size_mb: Callable[[str], float]) -> ResidencyPlan:
    """What workers should hold. ``size_mb`` estimates the memory of a scene. Deterministic."""
    shelves = _Shelves(sites, needs, size_mb)
    wanted = _SlotsWanted(needs, sites.slots)
    having = {need.bundle_digest: sorted(sites.having(need.bundle_digest)) for need in needs}
    # Among what is needed now, what is resident goes first: evicting it to load another would only cost a load.
    ordered = sorted(
        needs, key=lambda n: (n.rank, not having[n.bundle_digest], n.turn, -n.count, n.bundle_digest)
    )
    ordered = in_turns(ordered, lambda need: size_mb(need.bundle_digest))
    homeless: list[str] = []
    for _, group in itertools.groupby(ordered, key=lambda need: need.rank):
        spreads = [_Spread(need, wanted.of(need), shelves, having[need.bundle_digest]) for need in group]
        # One copy of each before a second of any: a second shall not push out another's only one.
        for spread in spreads:
            spread.place_one()
        for spread in spreads:
            spread.place_more()
        homeless += [spread.need.bundle_digest for spread in spreads if not spread.placed]
    return ResidencyPlan(shelves.close(), tuple(homeless))


class _SlotsWanted:
    """What each need may have of all slots: its part of what its run may have, no more than its rollouts can keep busy."""

    def __init__(self, needs: Sequence[Need], slots: int) -> None:
        self._totals: dict[int, Counter[RunShare]] = {}
        for need in needs:
            self._totals.setdefault(need.rank, Counter())[need.share] += need.count
        # Groups of a step come one by one: those that are here share the slots with those that come next.
        if 0 in self._totals:
            self._totals[0] += self._totals.get(1, Counter())
        self._quotas = {rank: quotas(totals, slots) for rank, totals in self._totals.items()}

    def of(self, need: Need) -> int:
        total = self._totals[need.rank][need.share]
        part = self._quotas[need.rank][need.share] * need.count / total
        return min(need.count, math.ceil(part - 1e-9))


class _Spread:
    """One need on its way to as many workers as it should be on: where it is first, then where there is least to do."""

    def __init__(self, need: Need, slots: int, shelves: _Shelves, having: Sequence[str]) -> None:
        self.need = need
        self.placed: list[_Shelf] = []
        self._slots = slots
        self._shelves = shelves
        self._here = [shelves.of(worker_id) for worker_id in having]

    def place_one(self) -> None:
        """Put it on one worker, with all its work."""
        scene = self.need.bundle_digest
        # Where rollouts run it stays: that needs no room.
        here = sorted(self._shelves.in_order(self._here), key=lambda shelf: scene not in shelf.chosen)
        for shelf in here:
            if scene in shelf.chosen or shelf.accepts(scene):
                self._put(shelf)
                break
        else:
            self._put_on_others(one=True)
        if self.placed:
            self._shelves.add_work(self.placed[0], self.need.count)

    def place_more(self) -> None:
        """Put it on more workers while that is worth it, and share the work among them all."""
        if not self.placed or not self._wants_more():
            return
        scene = self.need.bundle_digest
        for shelf in self._shelves.in_order(self._here):
            if shelf in self.placed or not self._wants_more():
                continue
            if scene in shelf.chosen or shelf.accepts(scene):
                self._put(shelf)
        if self._wants_more():
            self._put_on_others(one=False)
        capacity = self._capacity()
        self._shelves.add_work(self.placed[0], -self.need.count)
        for shelf in self.placed:
            self._shelves.add_work(shelf, self.need.count * shelf.site.capacity / capacity)

    def _put_on_others(self, *, one: bool) -> None:
        with contextlib.closing(self._shelves.accepting(self.need.bundle_digest)) as others:
            for shelf in others:
                self._put(shelf)
                if one or not self._wants_more():
                    break

    def _put(self, shelf: _Shelf) -> None:
        if self.need.bundle_digest not in shelf.chosen:
            shelf.take(self.need.bundle_digest)
        self.placed.append(shelf)

    def _wants_more(self) -> bool:
        """Whether it should be on one more: that has slots for it, and is done loading before the others are with the work."""
        if len(self.placed) < self.need.at_least:
            return True
        if sum(shelf.site.slots for shelf in self.placed) >= self._slots:
            return False
        known = self.need.load_s and self.need.work_s
        return not known or self.need.work_s / self._capacity() > self.need.load_s

    def _capacity(self) -> float:
        return sum(shelf.site.capacity for shelf in self.placed)
