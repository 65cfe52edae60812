"""Workers come, report, change their standing and go: what that means for the leases that they hold."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.manager.control.commands import CancelLease
from embomatrix.manager.control.events import (
    WorkerDrained,
    WorkerJoined,
    WorkerLost,
    WorkerRecovered,
    WorkerReported,
    WorkerResumed,
    WorkerSuspected,
)
from embomatrix.rpc.wire.values import InfraCode, InfraFailure, ResidentState

if TYPE_CHECKING:
    from embomatrix.manager.control.dispatch.assignments import Assignments
    from embomatrix.manager.control.dispatch.ledger import WorkerRecord
    from embomatrix.manager.control.dispatch.recovery import Recovery


class Attendance:
    """Keeps the desk's fleet as workers tell it. What is told of a worker that is gone changes nothing."""

    def __init__(self, desk: Assignments, recovery: Recovery) -> None:
        self._desk = desk
        self._recovery = recovery

    def joined(self, event: WorkerJoined) -> None:
        """A worker registered: leases of an older session of it are void."""
        self.lost(WorkerLost(event.worker_id, "a newer session of the same worker took over"))
        resources = event.resources
        joined = self._desk.fleet.join(
            event.worker_id,
            resources.slots,
            resources.render_slots,
            resources.versions,
        )
        self._desk.audits.joined(joined)

    def reported(self, event: WorkerReported) -> None:
        """Its full state: what it holds warm, whether it takes leases, and which of them it has."""
        worker = self._desk.fleet.workers.get(event.worker_id)
        if worker is None:
            return
        worker.reported = True
        worker.leaving, worker.paused = event.draining, event.paused
        self._desk.fleet.stand(worker)
        self._desk.fleet.set_warm(
            worker, (r.bundle_digest for r in event.residents if r.state is ResidentState.WARM)
        )
        if event.resync:
            self._reconcile(worker, event)
        self._desk.leases.renew(worker.worker_id, event.held, self._desk.now_s)
        for scene in worker.warm:
            self._desk.failures.forget(scene)
        for resident in event.residents:
            if resident.state is ResidentState.FAILED:
                self._desk.failures.record(
                    resident.bundle_digest, worker.worker_id, resident.error, self._desk.now_s
                )
                self._desk.judge(resident.bundle_digest)
        self._desk.fill([worker.worker_id])

    def _reconcile(self, worker: WorkerRecord, event: WorkerReported) -> None:
        """After a reconnect: what the worker does not hold never reached it.

        What it holds beyond our book, a former manager gave: it is taken up, or void.
        """
        held = set(event.held)
        failure = InfraFailure(
            InfraCode.WORKER_LOST, "the lease was lost with a broken session", worker.worker_id
        )
        for lease in [lease for lease in worker.held.values() if lease.ref not in held]:
            self._desk.give_back(lease, failure, counted=False)
            self._desk.offer(lease.record.scene)
        self._recovery.heard(worker.worker_id)
        origins = {claim.ref: claim.origin for claim in event.claims}
        for ref in event.held:
            if self._desk.leases.find(worker.worker_id, ref) is not None:
                continue
            if not self._recovery.adopt(worker, ref, origins.get(ref)):
                self._desk.commands.append(CancelLease(worker.worker_id, ref))

    def lost(self, event: WorkerLost) -> None:
        """What it held goes to others."""
        worker = self._desk.fleet.workers.get(event.worker_id)
        if worker is None:
            return
        leases = list(worker.held.values())
        self._desk.fleet.leave(worker.worker_id)
        failure = InfraFailure(InfraCode.WORKER_LOST, f"worker lost: {event.reason}", worker.worker_id)
        for lease in leases:
            self._desk.give_back(lease, failure, counted=lease.started_s is not None)
        for scene in dict.fromkeys(lease.record.scene for lease in leases):
            self._desk.offer(scene)

    def standing(self, event: WorkerSuspected | WorkerRecovered | WorkerDrained | WorkerResumed) -> None:
        """It may take leases, or no longer."""
        worker = self._desk.fleet.workers.get(event.worker_id)
        if worker is None:
            return
        match event:
            case WorkerDrained() | WorkerResumed():
                worker.drained = isinstance(event, WorkerDrained)
                if isinstance(event, WorkerResumed):
                    self._desk.audits.pardon(worker)
            case WorkerSuspected() | WorkerRecovered():
                worker.suspect = isinstance(event, WorkerSuspected)
        self._desk.fleet.stand(worker)
        self._desk.fill([event.worker_id])
