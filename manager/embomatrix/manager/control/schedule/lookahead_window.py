"""What a run announced: the scenes of its coming steps, without those that have come."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.rpc.wire.values import Batch, LookaheadEntry


class LookaheadWindow:
    """What a run announced last, without what has come."""

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

    def come(self, batch: Batch) -> None:
        """Drop the steps before the batch's, and of its own step its scenes: the other groups are still to come."""
        for step in [step for step in self._steps if step < batch.step]:
            del self._steps[step]
        for scene in {rollout.bundle_digest for rollout in batch.rollouts}:
            self._steps.get(batch.step, {}).pop(scene, None)


def announcers(windows: Mapping[str, LookaheadWindow]) -> dict[str, str]:
    """Whose look-ahead each scene is in; the run that was there first where it is in several."""
    found: dict[str, str] = {}
    for run_id, window in windows.items():
        for scene in window.scenes:
            found.setdefault(scene, run_id)
    return found
