"""Which scenes failed to load, and where: one worker is to blame until a second one agrees that it is the scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from embomatrix.rpc.wire.values import InfraCode, InfraFailure

WITNESSES: Final = 2
"""Distinct workers that must fail before the scene itself is to blame."""
MEMORY_S: Final = 60.0
"""A failure that is not repeated for this long is forgotten, so that a mended scene gets another try."""


@dataclass(slots=True)
class _Failure:
    first_s: float
    last_s: float
    error: str


class LoadFailures:
    """Failures by scene and worker."""

    def __init__(self) -> None:
        self._by_scene: dict[str, dict[str, _Failure]] = {}

    def record(self, scene: str, worker_id: str, error: str, now_s: float) -> None:
        failures = self._by_scene.setdefault(scene, {})
        known = failures.get(worker_id)
        failures[worker_id] = _Failure(known.first_s if known else now_s, now_s, error)

    def forget(self, scene: str) -> None:
        """The scene is warm somewhere: it can be loaded."""
        self._by_scene.pop(scene, None)

    def scenes(self) -> tuple[str, ...]:
        return tuple(self._by_scene)

    def verdict(self, scene: str, *, live: int, patience_s: float, now_s: float) -> InfraFailure | None:
        """What to tell the rollouts of the scene, or None while another worker may still manage.

        ``live`` workers are there to try. Where there is only one, the scene gets ``patience_s`` from the first failure.
        """
        failures = self._by_scene.get(scene, {})
        for worker_id in [name for name, failure in failures.items() if now_s - failure.last_s > MEMORY_S]:
            del failures[worker_id]
        if not failures:
            self._by_scene.pop(scene, None)
            return None
        alone = live <= len(failures) and now_s - min(f.first_s for f in failures.values()) >= patience_s
        if len(failures) < WITNESSES and not alone:
            return None
        worker_id, failure = max(failures.items(), key=lambda item: item[1].last_s)
        workers = ", ".join(sorted(failures))
        message = f"scene {scene} could not be loaded by {workers}: {failure.error or 'no reason given'}"
        return InfraFailure(InfraCode.SCENE_LOAD_FAILED, message, worker_id)
