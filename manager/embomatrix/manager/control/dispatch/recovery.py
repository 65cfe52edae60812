"""What a former manager left: its leases are taken up from the workers that hold them, the rest is given out after a while.

No lease is written down when it is given. A worker that comes back says which leases and results it holds, under which
epochs and for which rollouts; that is enough to go on with them.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from embomatrix.manager.control.dispatch.ledger import DispatchPhase

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.manager.control.dispatch.assignments import Assignments
    from embomatrix.manager.control.dispatch.ledger import RolloutKey, RolloutRecord, WorkerRecord
    from embomatrix.manager.control.events import BatchRestored
    from embomatrix.rpc.wire.leases import LeaseOrigin, LeaseRef


class Recovery:
    """Rollouts of restored batches wait here: queued earlier, those that run would run a second time.

    The wait ends when all workers that were there before have said what they hold, or after ``grace_s``.
    """

    def __init__(self, desk: Assignments, *, grace_s: float) -> None:
        self._desk = desk
        self._grace_s = grace_s
        self._until_s = 0.0
        self._awaited: dict[RolloutKey, RolloutRecord] = {}
        self._scenes: Counter[str] = Counter()
        self._expected: set[str] | None = None

    @property
    def waiting(self) -> int:
        """Rollouts that somebody may hold."""
        return sum(record.phase is not DispatchPhase.DONE for record in self._awaited.values())

    def awaited(self) -> Mapping[str, int]:
        """Rollouts that somebody may hold, by scene."""
        return self._scenes

    @property
    def expected(self) -> frozenset[str]:
        """Workers that were there before and are still waited for."""
        return frozenset(self._expected or ()) if self._awaited else frozenset()

    def expect(self, worker_ids: frozenset[str]) -> None:
        """These were there under the former manager, and no others."""
        self._expected = set(worker_ids)

    def heard(self, worker_id: str) -> None:
        """The worker has said what it holds."""
        if self._expected is not None:
            self._expected.discard(worker_id)

    def restore(self, event: BatchRestored) -> None:
        """Take over a batch. Its counters and cursors go on where they were."""
        counters = self._desk.runs.of(event.batch.run_id).counters
        counters.delivered += len(event.delivered)
        counters.infra_failures += event.infra_failures
        batch = self._desk.open(event.batch, event.delivered)
        for record in self._desk.batches.admit(batch) if batch is not None else ():
            self._awaited[record.key] = record
            self._scenes[record.scene] += 1
        self._until_s = self._desk.now_s + self._grace_s

    def adopt(self, worker: WorkerRecord, ref: LeaseRef, origin: LeaseOrigin | None) -> bool:
        """Take up a former manager's lease that the worker holds; tells whether it is valid.

        It is void when the rollout has its outcome, or when a lease with a higher epoch was given for it since.
        """
        if origin is None or not self._desk.leases.is_former(ref):
            return False
        batch = self._desk.batches.get((origin.run_id, origin.batch_id))
        record = batch.open.get(origin.rollout_id) if batch is not None else None
        others = list(record.leases) if record is not None else []
        if record is None or any(other.ref.lease_epoch >= ref.lease_epoch for other in others):
            self._desk.leases.disown(ref, origin.run_id)
            return False
        for other in others:
            self._desk.void(other)
        if record.phase is DispatchPhase.PENDING:
            self._desk.pending.take(record)
        self._forget(record)
        record.attempts = max(record.attempts, origin.attempt - 1)
        self._desk.leases.note(ref, record, worker, self._desk.now_s)
        return True

    def tick(self) -> None:
        """Once the workers are back or had their time, what nobody holds is queued."""
        all_are_back = self._expected is not None and not self._expected
        if not self._awaited or not (all_are_back or self._desk.now_s >= self._until_s):
            return
        left = [record for record in self._awaited.values() if record.phase is not DispatchPhase.DONE]
        self._awaited.clear()
        self._scenes.clear()
        self._desk.queue(left)

    def _forget(self, record: RolloutRecord) -> None:
        if self._awaited.pop(record.key, None) is not None:
            self._scenes[record.scene] -= 1
            if not self._scenes[record.scene]:
                del self._scenes[record.scene]
