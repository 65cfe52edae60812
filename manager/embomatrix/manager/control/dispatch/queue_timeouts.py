"""How long rollouts wait while nobody can take them: the end of the wait, with the reason."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.rpc.wire.values import InfraCode, InfraFailure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.manager.control.dispatch.assignments import Assignments


class QueueTimeouts:
    """Ends rollouts that waited for ``limit_s`` while no worker was there, or none that could hold their scene."""

    def __init__(self, desk: Assignments, limit_s: float) -> None:
        self._desk = desk
        self._limit_s = limit_s
        self._unplaceable: dict[str, tuple[float, str]] = {}
        """Since when no worker can hold a scene, and why."""
        self._alone_since_s = 0.0

    def note_unplaceable(self, reasons: Mapping[str, str]) -> None:
        """These scenes, and no others, find no worker now."""
        known, now_s = self._unplaceable, self._desk.now_s
        self._unplaceable = {
            scene: (known[scene][0] if scene in known else now_s, text) for scene, text in reasons.items()
        }

    def give_up(self) -> None:
        """End what has waited for long enough."""
        desk, limit_s = self._desk, self._limit_s
        if desk.fleet.live or desk.paused:
            self._alone_since_s = desk.now_s
            for scene, (since_s, text) in list(self._unplaceable.items()):
                if desk.now_s - since_s >= limit_s:
                    self._end_waiting(scene, text)
        elif desk.now_s - self._alone_since_s >= limit_s:
            count = len(desk.fleet.workers)
            there = f"{count} are paused, draining or silent" if count else "none is there"
            text = f"no worker took work for {limit_s:g} s, {there}: start one with `embomatrix worker run`"
            for scene in desk.pending.counts():
                self._end_waiting(scene, text)

    def _end_waiting(self, scene: str, text: str) -> None:
        """End those rollouts of the scene that waited for the bounded time; later ones keep their own wait."""
        desk = self._desk
        while (record := desk.pending.oldest(scene)) is not None:
            if desk.now_s - record.submitted_s < self._limit_s:
                return
            desk.finish(record, InfraFailure(InfraCode.NO_CAPACITY, text))
