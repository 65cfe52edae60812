"""Readiness forecast for trainers and operators: when each scene will be warm, or why it will not."""

from collections import OrderedDict
from collections.abc import Mapping
from typing import Final

from embomatrix.manager.control.schedule.lookahead import LookaheadWindow
from embomatrix.manager.control.schedule.residency import Residencies, WorkerResidency
from embomatrix.rpc.wire.values import LookaheadAnswer, PlanCell, Resident, ResidentState, Warmth

SCENES_KEPT: Final = 16_384
"""Scenes whose costs are remembered: those that workers reported last."""
BELIEVED_MB: Final = 1_024.0
"""Most memory of a scene that one worker's report proves. More counts as far as a second worker reports it."""
BELIEVED_S: Final = 60.0
"""Longest load time that is learnt, so that one false report does not keep scenes from other workers."""
LEARNING: Final = 0.05
"""Weight of the latest measurement in moving averages."""


class SceneCosts:
    """Measured memory, load time and execution time of scenes. Times are 0 before the first measurement."""

    def __init__(self, guess_mb: float) -> None:
        self._guess_mb = guess_mb
        self.measured_mb: OrderedDict[str, float] = OrderedDict()
        self._large: dict[str, list[tuple[float, str]]] = {}
        #: Scenes reported beyond ``BELIEVED_MB``: the two largest reports of different workers.
        self.load_s: OrderedDict[str, float] = OrderedDict()
        self.typical_load_s = 0.0
        self.execute_s = 0.0
        """Execution time on a slot of speed 1."""

    def size_mb(self, scene: str) -> float:
        return self.measured_mb.get(scene, self._guess_mb)

    def usual_load_s(self, scene: str) -> float:
        """Return the load time of the scene, or of a typical one."""
        return self.load_s.get(scene, self.typical_load_s)

    def learn(self, worker_id: str, resident: Resident) -> None:
        scene, load_s = resident.bundle_digest, min(resident.load_s, BELIEVED_S)
        if resident.memory_mb > 0:
            proven_mb = self._proven_mb(worker_id, scene, resident.memory_mb)
            self.measured_mb[scene] = max(self.measured_mb.get(scene, 0.0), proven_mb)
        if resident.state is ResidentState.WARM and load_s > 0:
            self.load_s[scene] = 0.5 * (self.load_s.get(scene, load_s) + load_s)
            self.typical_load_s = _averaged(self.typical_load_s, load_s)
        for costs in (self.measured_mb, self.load_s):
            if scene in costs:
                costs.move_to_end(scene)
            if len(costs) > SCENES_KEPT:
                forgotten, _ = costs.popitem(last=False)
                if costs is self.measured_mb:
                    self._large.pop(forgotten, None)

    def executed(self, seconds: float) -> None:
        """Add an execution time, in seconds on a slot of speed 1."""
        self.execute_s = _averaged(self.execute_s, seconds)

    def _proven_mb(self, worker_id: str, scene: str, memory_mb: float) -> float:
        """Return the part of the reported memory that one worker may prove, or that two agree on."""
        if memory_mb <= BELIEVED_MB:
            return memory_mb
        reports = {name: size for size, name in self._large.get(scene, ())}
        reports[worker_id] = max(reports.get(worker_id, 0.0), memory_mb)
        largest = sorted(((size, name) for name, size in reports.items()), reverse=True)[:2]
        self._large[scene] = largest
        return largest[1][0] if len(largest) > 1 else BELIEVED_MB


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
