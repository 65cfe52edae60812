"""What scenes cost, as workers told: memory, loading, and an execution in one of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.rpc.wire.values import ResidentState

if TYPE_CHECKING:
    from embomatrix.rpc.wire.values import Resident

LEARNING: Final = 0.05
"""Weight of the latest of a row of measurements."""


class SceneCosts:
    """A scene that no worker has loaded yet is taken to hold ``guess_mb``. Seconds are 0 while nobody knows."""

    def __init__(self, guess_mb: float) -> None:
        self._guess_mb = guess_mb
        self.known_mb: dict[str, float] = {}
        self.load_s: dict[str, float] = {}
        self.typical_load_s = 0.0
        """Of any scene, as lately measured."""
        self.execute_s = 0.0
        """Of an execution on a worker of speed 1, as lately measured."""

    def size_mb(self, scene: str) -> float:
        return self.known_mb.get(scene, self._guess_mb)

    def usual_load_s(self, scene: str) -> float:
        """What loading the scene takes, or a scene as a rule while nobody knows; 0 before the first."""
        return self.load_s.get(scene, self.typical_load_s)

    def learn(self, resident: Resident) -> None:
        """A worker told of a scene that it holds."""
        scene = resident.bundle_digest
        if resident.memory_mb > 0:
            self.known_mb[scene] = max(self.known_mb.get(scene, 0.0), resident.memory_mb)
        if resident.state is ResidentState.WARM and resident.load_s > 0:
            before_s = self.load_s.get(scene, resident.load_s)
            self.load_s[scene] = 0.5 * (before_s + resident.load_s)
            self.typical_load_s = _learned(self.typical_load_s, resident.load_s)

    def executed(self, seconds: float) -> None:
        """An execution took so long, or would have on a worker of speed 1."""
        self.execute_s = _learned(self.execute_s, seconds)


def _learned(before: float, measured: float) -> float:
    return before + LEARNING * (measured - before) if before else measured
