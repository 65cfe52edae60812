"""Look-ahead windows of runs, and what loading scenes ahead was worth."""

from collections.abc import Iterable
from dataclasses import dataclass, field

from embomatrix.manager.histogram import Histogram
from embomatrix.rpc.wire.values import Batch, LookaheadEntry


class LookaheadWindow:
    """Scenes of a run's coming steps, by its last announcement, without those that batches have used up."""

    def __init__(self, version: int, entries: tuple[LookaheadEntry, ...]) -> None:
        self.version = version
        self._steps: dict[int, dict[str, list[LookaheadEntry]]] = {}
        for entry in entries:
            self._steps.setdefault(entry.step, {}).setdefault(entry.bundle_digest, []).append(entry)

    @property
    def entries(self) -> tuple[LookaheadEntry, ...]:
        return tuple(entry for step in self._steps.values() for found in step.values() for entry in found)

    @property
    def scenes(self) -> set[str]:
        return {scene for step in self._steps.values() for scene in step}

    def announces(self, scene: str) -> bool:
        return any(scene in step for step in self._steps.values())

    def consume(self, batch: Batch) -> None:
        """Drop the steps before the batch's, and the batch's scenes from its own step: other groups are still to come."""
        for step in [step for step in self._steps if step < batch.step]:
            del self._steps[step]
        for scene in {rollout.bundle_digest for rollout in batch.rollouts}:
            self._steps.get(batch.step, {}).pop(scene, None)


@dataclass(slots=True)
class PrewarmCounters:
    """Counters of one run. A hit is a scene that was warm when its batch arrived."""

    hits: int = 0
    misses: int = 0
    wasted: int = 0
    """Scenes loaded ahead and never used."""
    leads: Histogram = field(default_factory=Histogram)
    """Seconds from warm to the arrival of the batch, for hits."""


class PrewarmLedger:
    """Follows each load that a look-ahead caused to its first use or its eviction."""

    def __init__(self) -> None:
        self.leads = Histogram()
        """Leads of the hits of all runs."""
        self._counters: dict[str, PrewarmCounters] = {}
        self._ahead: dict[str, dict[str, str]] = {}
        """Run that had a scene loaded ahead, by worker and scene, until its first use."""

    def counters(self, run_id: str) -> PrewarmCounters:
        return self._counters.setdefault(run_id, PrewarmCounters())

    def ordered(self, worker_id: str, scene: str, run_id: str) -> None:
        """Note a load that the run's look-ahead caused."""
        self._ahead.setdefault(worker_id, {}).setdefault(scene, run_id)

    def demanded(self, run_id: str, warm_since_s: float | None, now_s: float) -> None:
        """Count a scene of a new batch as hit, or as miss if it is warm nowhere (None)."""
        counters = self.counters(run_id)
        if warm_since_s is None:
            counters.misses += 1
        else:
            counters.hits += 1
            counters.leads.observe(now_s - warm_since_s)
            self.leads.observe(now_s - warm_since_s)

    def used(self, pairs: Iterable[tuple[str, str]]) -> None:
        for worker_id, scene in pairs:
            self.withdrawn(worker_id, scene)

    def evicted(self, worker_id: str, scene: str) -> None:
        """Count a scene that leaves the worker unused after it was loaded ahead."""
        run_id = self.withdrawn(worker_id, scene)
        if run_id is not None:
            self.counters(run_id).wasted += 1

    def withdrawn(self, worker_id: str, scene: str) -> str | None:
        """Forget a load ahead, which is used now or was cancelled in time; return its run."""
        return self._ahead.get(worker_id, {}).pop(scene, None)

    def lost(self, worker_id: str) -> None:
        """Forget the loads of a lost worker; they do not count as waste."""
        self._ahead.pop(worker_id, None)

    def close(self, run_id: str) -> None:
        """Count the unused loads of a run that ends as waste."""
        for worker_id, scenes in self._ahead.items():
            for scene in [scene for scene, owner in scenes.items() if owner == run_id]:
                self.evicted(worker_id, scene)

    def forget(self, run_id: str) -> None:
        """Drop the counters of a closed run."""
        self._counters.pop(run_id, None)
