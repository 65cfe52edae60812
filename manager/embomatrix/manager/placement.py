"""Where scenes should be resident: a pure function of what is needed, when, and how much each worker can hold.

Needs are placed in order of their next use, each where it costs least: on a worker that has it already, else on the one
with the least work. What a worker's memory has no room for is then by construction what is needed last: eviction by
furthest next use (Belady), which is possible here because the trainer says what comes.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

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
        self._size_mb = size_mb
        self._free_mb = site.memory_mb
        for scene in sorted(site.pinned):
            self.take(scene)

    def has_room_for(self, scene: str) -> bool:
        """The first scene always fits: an estimate shall not keep a small worker from trying."""
        return not self.chosen or self._size_mb(scene) <= self._free_mb

    def accepts(self, scene: str) -> bool:
        return scene not in self.site.refused and self.has_room_for(scene)

    def take(self, scene: str) -> None:
        self.chosen[scene] = None
        self._free_mb -= self._size_mb(scene)

    @property
    def load(self) -> float:
        """Work per slot, weighed by the worker's speed."""
        return self.work / (self.site.slots * max(self.site.score, 1e-3))


def place(
    sites: Sequence[Site], needs: Sequence[Need], size_mb: Callable[[str], float]
) -> dict[str, tuple[str, ...]]:
    """What each worker should hold, most urgent first. ``size_mb`` estimates the memory of a scene. Deterministic."""
    shelves = [_Shelf(site, size_mb) for site in sorted(sites, key=lambda site: site.worker_id)]
    having: dict[str, list[_Shelf]] = {}
    for shelf in shelves:
        for scene in (*shelf.site.residents, *shelf.chosen):
            if shelf not in having.setdefault(scene, []):
                having[scene].append(shelf)
    totals: dict[int, int] = {}
    for need in needs:
        totals[need.rank] = totals.get(need.rank, 0) + need.count
    # Among what is needed now, what is resident goes first: evicting it to load another would only cost a load.
    for need in sorted(
        needs, key=lambda n: (n.rank, n.bundle_digest not in having, -n.count, n.bundle_digest)
    ):
        _place_copies(need, shelves, having, _copies(need, sites, totals[need.rank]))
    for shelf in shelves:
        for scene in shelf.site.residents:
            if scene not in shelf.chosen and shelf.has_room_for(scene):
                shelf.take(scene)
    return {shelf.site.worker_id: tuple(shelf.chosen) for shelf in shelves}


def _copies(need: Need, sites: Sequence[Site], total: int) -> int:
    """On how many workers: the scene's share of all slots, no more than its rollouts can keep busy."""
    slots = sum(site.slots for site in sites)
    if not slots or not total:
        return 1
    slots_each = slots / len(sites)
    share = slots * need.count / total / slots_each
    busy = math.ceil(need.count / slots_each)
    return min(len(sites), max(1, need.at_least, min(math.ceil(share - 1e-9), busy)))


def _place_copies(
    need: Need, shelves: Sequence[_Shelf], having: Mapping[str, list[_Shelf]], copies: int
) -> None:
    """Put the scene on up to that many workers: where it is first, then where there is least to do."""
    scene = need.bundle_digest
    here = having.get(scene, [])
    placed = [shelf for shelf in here if scene in shelf.chosen]
    for shelf in sorted(here, key=lambda shelf: (shelf.load, shelf.site.worker_id)):
        if len(placed) < copies and shelf not in placed and shelf.accepts(scene):
            shelf.take(scene)
            placed.append(shelf)
    if len(placed) < copies:
        others = (shelf for shelf in shelves if scene not in shelf.chosen and shelf.accepts(scene))
        for shelf in heapq.nsmallest(copies - len(placed), others, key=lambda s: (s.load, s.site.worker_id)):
            shelf.take(scene)
            placed.append(shelf)
    for shelf in placed:
        shelf.work += need.count / len(placed)
