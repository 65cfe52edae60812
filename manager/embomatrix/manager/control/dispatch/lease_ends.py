"""How leases end: by a result, by a failure, or too late."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from embomatrix.manager.control.commands import AcknowledgeLease
from embomatrix.rpc.wire.values import Completed, InfraCode, InfraFailure

if TYPE_CHECKING:
    from embomatrix.manager.control.dispatch.assignments import Assignments
    from embomatrix.manager.control.dispatch.ledger import LeaseRecord
    from embomatrix.manager.control.events import LeaseFinished


class LeaseEnds:
    """Takes what workers report of leases to the desk. A result under an epoch that is not live is stale and dropped."""

    def __init__(self, desk: Assignments) -> None:
        self._desk = desk

    def settle(self, event: LeaseFinished) -> None:
        """The worker may forget it; what it is worth, the lease's epoch tells."""
        self._desk.commands.append(AcknowledgeLease(event.worker_id, event.ref))
        lease = self._desk.leases.find(event.worker_id, event.ref)
        if lease is None:
            run_id = self._desk.leases.run_of_ended(event.ref)
            if run_id is not None and run_id in self._desk.runs:
                self._desk.runs.of(run_id).counters.stale_results += 1
            return
        match event.outcome:
            case Completed() as completed:
                self._complete(lease, completed)
            case InfraFailure() as failure:
                self._take_failure(
                    lease, dataclasses.replace(failure, worker_id=failure.worker_id or event.worker_id)
                )

    def _complete(self, lease: LeaseRecord, completed: Completed) -> None:
        record = lease.record
        self._desk.end(lease)
        record.attempts += 1
        run = self._desk.runs.of(record.key.run_id)
        self._desk.fleet.time(lease, run.times, self._desk.now_s, lost=False)
        for other in record.leases:
            self._desk.fleet.time(other, run.times, self._desk.now_s, lost=True)
        self._desk.fleet.workers[lease.worker_id].note_completed(completed.timings.execute_s)
        timings = lease.timings(completed.timings, self._desk.now_s)
        warm = record.warm and completed.warm
        noted = completed.noted(timings=timings, warm=warm, worker_id=lease.worker_id)
        if not record.check:
            run.counters.warm_starts += record.warm
            run.counters.cold_starts += not record.warm
            if self._desk.audits.hold(lease, noted):
                return
        self._desk.finish(record, noted)

    def _take_failure(self, lease: LeaseRecord, failure: InfraFailure) -> None:
        worker = self._desk.fleet.workers[lease.worker_id]
        scene = lease.record.scene
        if failure.code in (InfraCode.SCENE_LOAD_FAILED, InfraCode.BUNDLE_CORRUPT):
            # Until the worker reports again it is not taken for warm: the rollout would come straight back.
            self._desk.fleet.set_warm(worker, worker.warm - {scene})
            self._desk.failures.record(scene, worker.worker_id, failure.message, self._desk.now_s)
        self._desk.give_back(lease, failure, counted=True)
        self._desk.judge(scene)
        self._desk.offer(scene)
