"""What happened to workers and scenes: joined and lost, warm, failed and evicted."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Final

from embomatrix.manager.observe.event_ring import EventRing
from embomatrix.manager.observe.histogram import Histogram
from embomatrix.rpc.run_log import EventKind, RunEvent
from embomatrix.rpc.wire.values import ResidentState

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.rpc.wire.values import Resident, Resources

EVENTS_KEPT: Final = 4096
REASON_CHARS: Final = 500


class FleetLog:
    """Belongs to no run. ``sequences`` is shared with the logs of runs, so that their events can be put in one order.

    ``epoch_s`` is the wall clock's time at second 0 of the monotonic clock that every ``now_s`` is of.
    """

    def __init__(self, sequences: Iterator[int], *, epoch_s: float) -> None:
        self.ring = EventRing(EVENTS_KEPT)
        self.scene_load = Histogram()
        self._sequences = sequences
        self._epoch_s = epoch_s
        self._residents: dict[str, dict[str, ResidentState]] = {}

    def joined(self, worker_id: str, resources: Resources, *, now_s: float) -> None:
        self._residents.pop(worker_id, None)
        self._note(EventKind.WORKER_JOINED, worker_id, now_s=now_s, size=resources.slots)

    def lost(self, worker_id: str, reason: str, *, now_s: float) -> None:
        self._residents.pop(worker_id, None)
        self._note(EventKind.WORKER_LOST, worker_id, now_s=now_s, message=reason)

    def residents(self, worker_id: str, residents: Sequence[Resident], *, now_s: float) -> None:
        """The worker's scenes, as it reports them: what changed since its last report is told."""
        before = self._residents.get(worker_id, {})
        after = {resident.bundle_digest: resident.state for resident in residents}
        self._residents[worker_id] = after
        note = functools.partial(self._note, worker_id=worker_id, now_s=now_s)
        for resident in residents:
            scene = resident.bundle_digest
            if before.get(scene) is resident.state:
                continue
            if resident.state is ResidentState.WARM:
                self.scene_load.observe(resident.load_s)
                note(EventKind.SCENE_WARM, scene=scene, held_s=resident.load_s)
            elif resident.state is ResidentState.FAILED:
                note(EventKind.SCENE_FAILED, scene=scene, message=resident.error)
        for scene, state in before.items():
            if scene not in after and state is ResidentState.WARM:
                note(EventKind.SCENE_EVICTED, scene=scene)

    def _note(
        self,
        kind: EventKind,
        worker_id: str,
        *,
        now_s: float,
        scene: str = "",
        message: str = "",
        held_s: float = 0.0,
        size: int = 0,
    ) -> None:
        self.ring.append(
            RunEvent(
                next(self._sequences),
                self._epoch_s + now_s,
                kind,
                worker_id=worker_id,
                bundle_digest=scene,
                message=message[:REASON_CHARS],
                held_s=held_s,
                size=size,
            )
        )
