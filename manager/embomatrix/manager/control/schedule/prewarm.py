"""What prewarming was worth: hits, misses, lead time, and loads that nobody used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from embomatrix.manager.histogram import Histogram

if TYPE_CHECKING:
    from collections.abc import Iterable


@dataclass(slots=True)
class PrewarmCounters:
    """Of one run. A hit: the scene was warm when its batch came. Waste: it was loaded ahead and never used."""

    hits: int = 0
    misses: int = 0
    wasted: int = 0
    leads: Histogram = field(default_factory=Histogram)
    """Of its hits: between a scene being warm and the batch that needed it."""


class PrewarmLedger:
    """Follows each (worker, scene) from the load that a look-ahead caused to its first use, or its eviction."""

    def __init__(self) -> None:
        self.leads = Histogram()
        """Of the hits of all runs."""
        self._counters: dict[str, PrewarmCounters] = {}
        self._ahead: dict[str, dict[str, str]] = {}
        """The run that had a scene loaded, by worker and scene."""

    def counters(self, run_id: str) -> PrewarmCounters:
        return self._counters.setdefault(run_id, PrewarmCounters())

    def ordered(self, worker_id: str, scene: str, run_id: str) -> None:
        """The scene is to be loaded there because the run announced it."""
        self._ahead.setdefault(worker_id, {}).setdefault(scene, run_id)

    def demanded(self, run_id: str, warm_since_s: float | None, now_s: float) -> None:
        """A batch needs a scene that has been warm since then, or is not warm anywhere (None)."""
        counters = self.counters(run_id)
        if warm_since_s is None:
            counters.misses += 1
        else:
            counters.hits += 1
            counters.leads.observe(now_s - warm_since_s)
            self.leads.observe(now_s - warm_since_s)

    def used(self, pairs: Iterable[tuple[str, str]]) -> None:
        for worker_id, scene in pairs:
            self._take(worker_id, scene)

    def evicted(self, worker_id: str, scene: str) -> None:
        """A warm scene left the worker; if it was loaded ahead and never used, the load was wasted."""
        run_id = self._take(worker_id, scene)
        if run_id is not None:
            self.counters(run_id).wasted += 1

    def withdrawn(self, worker_id: str, scene: str) -> None:
        """The load was called off before it began: it cost nothing."""
        self._take(worker_id, scene)

    def lost(self, worker_id: str) -> None:
        """The worker went with its scenes: nobody's waste."""
        self._ahead.pop(worker_id, None)

    def close(self, run_id: str) -> None:
        """The run is over: what it had loaded ahead and not used is waste."""
        for worker_id, scenes in self._ahead.items():
            for scene in [scene for scene, owner in scenes.items() if owner == run_id]:
                self.evicted(worker_id, scene)

    def forget(self, run_id: str) -> None:
        """Drop the counters of a closed run."""
        self._counters.pop(run_id, None)

    def _take(self, worker_id: str, scene: str) -> str | None:
        return self._ahead.get(worker_id, {}).pop(scene, None)

    @property
    def runs(self) -> tuple[PrewarmCounters, ...]:
        return tuple(self._counters.values())
