"""Readiness forecast for trainers and operators: when each scene will be warm, or why it will not."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import median_low
from typing import Final

from embomatrix.manager.control.schedule.lookahead import LookaheadWindow
from embomatrix.manager.control.schedule.residency import Residencies, WorkerResidency, keep_newest
from embomatrix.rpc.wire.values import LookaheadAnswer, PlanCell, Resident, ResidentState, Warmth

BELIEVED_S: Final = 60.0
"""Longest load time that is learnt, so that one false report does not keep scenes from other workers."""
LEARNING: Final = 0.05
"""Weight of the latest measurement in moving averages."""
KNOWN_SCENES: Final = 8_192
"""Scenes whose measurements are kept. Those that were first measured earliest are forgotten."""
WITNESSES: Final = 9
"""Workers whose measurements of a scene are kept."""


@dataclass(slots=True)
class _Measured:
    """Measurements of one scene by worker, and what counts."""

    memory_mb: dict[str, float] = field(default_factory=dict)
    load_s: dict[str, float] = field(default_factory=dict)
    usual_mb: float = 0.0
    usual_load_s: float = 0.0

    def update(self) -> None:
        self.usual_mb = median_low(self.memory_mb.values()) if self.memory_mb else 0.0
        self.usual_load_s = median_low(self.load_s.values()) if self.load_s else 0.0


_UNKNOWN: Final = _Measured()


class SceneCosts:
    """Measured memory, load time and execution time of scenes. Times are 0 before the first measurement.

    The lower median of the present workers counts: a lie counts only while no other worker has measured the scene.
    """

    def __init__(self, guess_mb: float) -> None:
        self._guess_mb = guess_mb
        self._scenes: dict[str, _Measured] = {}
        self.typical_load_s = 0.0
        self.execute_s = 0.0
        """Execution time on a slot of speed 1."""

    def size_mb(self, scene: str) -> float:
        return self._scenes.get(scene, _UNKNOWN).usual_mb or self._guess_mb

    def load_s(self, scene: str) -> float:
        """Return the load time of the scene; 0 while it is unknown."""
        return self._scenes.get(scene, _UNKNOWN).usual_load_s

    def usual_load_s(self, scene: str) -> float:
        """Return the load time of the scene, or of a typical one."""
        return self.load_s(scene) or self.typical_load_s

    def learn(self, worker_id: str, resident: Resident) -> None:
        """Add the measurements of a worker."""
        known = self._scenes.get(resident.bundle_digest)
        if known is None:
            known = self._scenes[resident.bundle_digest] = _Measured()
            keep_newest(self._scenes, KNOWN_SCENES)
        changed, loaded = False, resident.state is ResidentState.WARM and resident.load_s > 0
        if resident.memory_mb > known.memory_mb.get(worker_id, 0.0):
            known.memory_mb[worker_id] = resident.memory_mb
            keep_newest(known.memory_mb, WITNESSES)
            changed = True
        load_s = min(resident.load_s, BELIEVED_S)
        if loaded and load_s != known.load_s.get(worker_id):
            known.load_s[worker_id] = load_s
            keep_newest(known.load_s, WITNESSES)
            changed = True
        if changed:
            known.update()
        if loaded:
            self.typical_load_s = _averaged(self.typical_load_s, known.usual_load_s)

    def forget(self, worker_id: str) -> None:
        """Drop the measurements of a worker that left."""
        for known in self._scenes.values():
            measured = known.memory_mb.pop(worker_id, None), known.load_s.pop(worker_id, None)
            if measured != (None, None):
                known.update()

    def executed(self, seconds: float) -> None:
        """Add an execution time, in seconds on a slot of speed 1."""
        self.execute_s = _averaged(self.execute_s, seconds)


class ReadinessForecast:
    """Forecast at one moment."""

    def __init__(
        self, residencies: Residencies, unplaceable: Mapping[str, str], costs: SceneCosts, now_s: float
    ) -> None:
        self._residencies = residencies
        self._unplaceable = unplaceable
        self._costs = costs
        self._now_s = now_s

    def warmth(self, scene: str) -> Warmth:
        holders = (self._residencies.by_id[name] for name in self._residencies.assigned_on(scene))
        if any(scene in residency.warm_since_s for residency in holders):
            return Warmth.WARM
        if scene in self._unplaceable:
            return Warmth.UNPLACEABLE
        return Warmth.WARMING if self._loading(scene) else Warmth.QUEUED

    def answer(self, scene: str) -> LookaheadAnswer:
        """Return the answer to the trainer that announced the scene."""
        warmth = self.warmth(scene)
        eta_s = 0.0
        if warmth is Warmth.WARMING:
            eta_s = min(self._left_s(residency, scene) for residency in self._loading(scene))
        return LookaheadAnswer(scene, warmth, eta_s, self._unplaceable.get(scene, ""))

    def grid(self, windows: Mapping[str, LookaheadWindow]) -> list[PlanCell]:
        """Return the announced scenes by run, step and scene."""
        cells: dict[tuple[str, int, str], int] = {}
        for run_id, window in windows.items():
            for entry in window.entries:
                key = (run_id, entry.step, entry.bundle_digest)
                cells[key] = cells.get(key, 0) + entry.count
        return [
            PlanCell(*key, count, self.warmth(key[2]), tuple(sorted(self._residencies.assigned_on(key[2]))))
            for key, count in sorted(cells.items())
        ]

    def _loading(self, scene: str) -> list[WorkerResidency]:
        """Return the workers that were ordered to load the scene."""
        residencies = (self._residencies.by_id[name] for name in self._residencies.assigned_on(scene))
        return [residency for residency in residencies if scene in (residency.desired or ())]

    def _left_s(self, residency: WorkerResidency, scene: str) -> float:
        """Return the remaining load time. A worker loads one scene per slot at a time, in the desired order."""
        load_s = self._costs.usual_load_s(scene)
        since_s = residency.loading_since_s.get(scene)
        if since_s is not None:
            return max(0.0, load_s - (self._now_s - since_s))
        ahead = residency.to_load(residency.desired or ()).index(scene)
        return load_s * (1 + ahead // residency.worker.slots)


def refusal_reason(residencies: Residencies, scene: str, size_mb: float, *, renders: bool) -> str:
    """Return in words why no worker takes the scene."""
    failing = (residencies.by_id[name].failure_messages for name in sorted(residencies.failing))
    errors = [messages[scene] for messages in failing if scene in messages]
    if errors:
        return f"scene {scene} fails to load: {next(filter(None, errors), 'no reason given')}"
    if renders and not any(residency.renders for residency in residencies.by_id.values()):
        return f"scene {scene} needs slots that render on a GPU, and no worker has any"
    return (
        f"scene {scene} needs {size_mb:.0f} MB and the largest worker gives {residencies.most_memory_mb} MB: "
        f"raise a worker's memory limit"
    )


def _averaged(before: float, measured: float) -> float:
    return before + LEARNING * (measured - before) if before else measured
