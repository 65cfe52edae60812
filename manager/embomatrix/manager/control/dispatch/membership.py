"""Workers that join, report, change their standing or are lost, and leases taken over from a former manager.

Leases are not stored when they are granted. After a restart of the manager its workers claim the leases and results that
they hold, with epochs and rollouts, and the new manager adopts them. Restored rollouts wait for these claims.
"""

from embomatrix.manager.control.commands import CancelLease
from embomatrix.manager.control.dispatch.audits import restore_quarantine
from embomatrix.manager.control.dispatch.lease_results import end_failed_lease, fail_unloadable_scene
from embomatrix.manager.control.dispatch.leasing import fill_workers, offer_scene, queue_rollouts, revoke
from embomatrix.manager.control.dispatch.outcomes import open_batch
from embomatrix.manager.control.dispatch.records import DispatchPhase
from embomatrix.manager.control.dispatch.state import DispatchState
from embomatrix.manager.control.events import (
    BatchRestored,
    DrainChanged,
    WorkerJoined,
    WorkerLost,
    WorkerReported,
)
from embomatrix.manager.control.workers import Standing, WorkerRecord
from embomatrix.rpc.wire.leases import LeaseOrigin, LeaseRef
from embomatrix.rpc.wire.run_log import RolloutStepKind
from embomatrix.rpc.wire.values import InfraCode, InfraFailure, ResidentState


def worker_joined(state: DispatchState, event: WorkerJoined) -> None:
    """Add a worker; leases of an older session of it end."""
    worker_lost(state, WorkerLost(event.worker_id, "a newer session of the same worker took over"))
    worker = state.pool.join(event.worker_id, event.resources)
    restore_quarantine(state, worker)


def worker_reported(state: DispatchState, event: WorkerReported) -> None:
    """Take over a worker's full state: warm scenes, standing and leases."""
    worker = state.pool.workers.get(event.worker_id)
    if worker is None:
        return
    worker.apply(event)
    state.pool.update_standing(worker)
    state.pool.set_warm(worker, (r.bundle_digest for r in event.residents if r.state is ResidentState.WARM))
    if event.resync:
        _reconcile(state, worker, event)
    state.leases.renew(worker.worker_id, event.held, state.now_s)
    for scene in worker.warm:
        state.load_failures.forget(scene)
    for resident in event.residents:
        if resident.state is ResidentState.FAILED:
            scene = resident.bundle_digest
            state.load_failures.record(scene, worker.worker_id, resident.error, state.now_s)
            fail_unloadable_scene(state, scene)
    fill_workers(state, (worker.worker_id,))


def worker_lost(state: DispatchState, event: WorkerLost) -> None:
    """Remove a worker and re-dispatch what it held."""
    worker = state.pool.workers.get(event.worker_id)
    if worker is None:
        return
    leases = list(worker.held.values())
    state.pool.leave(worker.worker_id)
    state.auditor.forget_blank(worker.worker_id)
    failure = InfraFailure(InfraCode.WORKER_LOST, f"worker lost: {event.reason}", worker.worker_id)
    for lease in leases:
        end_failed_lease(state, lease, failure, counted=lease.started_s is not None)
    for scene in dict.fromkeys(lease.record.scene for lease in leases):
        offer_scene(state, scene)


def standing_changed(state: DispatchState, event: Standing) -> None:
    """Apply a drain, a resume, a suspicion or a recovery."""
    worker = state.pool.workers.get(event.worker_id)
    if worker is None:
        return
    worker.apply(event)
    if isinstance(event, DrainChanged) and not event.drained:
        state.auditor.pardon(worker.worker_id)
        restore_quarantine(state, worker)
    state.pool.update_standing(worker)
    fill_workers(state, (event.worker_id,))


def restore_batch(state: DispatchState, event: BatchRestored) -> None:
    """Take over a batch of a former manager. Its cursors continue, and the run's counts of delivered outcomes and failures.

    Other counters begin at 0. Its open rollouts wait for claims.
    """
    counters = state.runs.of(event.batch.run_id).counters
    counters.delivered += event.outcomes
    counters.infra_failures += event.infra_failures
    batch = open_batch(state, event.batch, event.delivered)
    for record in state.batches.admit(batch) if batch is not None else ():
        state.awaited[record.key] = record
        state.awaited_scenes[record.scene] += 1
    state.awaited_until_s = state.now_s + state.limits.restart_grace_s


def release_awaited(state: DispatchState) -> None:
    """Queue the rollouts that no worker claimed, once all expected workers have reported or the grace time is over."""
    all_back = state.expected_workers is not None and not state.expected_workers
    if not state.awaited or not (all_back or state.now_s >= state.awaited_until_s):
        return
    state.awaited_until_s = state.now_s
    left = [record for record in state.awaited.values() if record.phase is not DispatchPhase.DONE]
    state.awaited.clear()
    state.awaited_scenes.clear()
    queue_rollouts(state, left)


def _reconcile(state: DispatchState, worker: WorkerRecord, event: WorkerReported) -> None:
    """Compare leases after a reconnect: missing ones never arrived, unknown ones are adopted or cancelled."""
    held = set(event.held)
    failure = InfraFailure(
        InfraCode.WORKER_LOST, "the lease was lost with a broken session", worker.worker_id
    )
    for lease in [lease for lease in worker.held.values() if lease.ref not in held]:
        end_failed_lease(state, lease, failure, counted=False)
        offer_scene(state, lease.record.scene)
    if state.expected_workers is not None:
        state.expected_workers.discard(worker.worker_id)
    origins = {claim.ref: claim.origin for claim in event.claims}
    for ref in event.held:
        known = state.leases.find(worker.worker_id, ref) is not None
        if not known and not _adopt(state, worker, ref, origins.get(ref)):
            state.emit(CancelLease(worker.worker_id, ref))


def _adopt(state: DispatchState, worker: WorkerRecord, ref: LeaseRef, origin: LeaseOrigin | None) -> bool:
    """Adopt a former manager's lease; True on success.

    A claim counts only within the grace time after a restart. The lease is void if the rollout has its outcome, or a
    lease with a higher epoch.
    """
    if origin is None or state.now_s >= state.awaited_until_s:
        return False
    if not state.leases.is_genuine(ref, origin, worker.worker_id):
        return False
    batch = state.batches.get((origin.run_id, origin.batch_id))
    record = batch.open.get(origin.rollout_id) if batch is not None else None
    others = list(record.leases) if record is not None else []
    if record is None or any(other.ref.lease_epoch >= ref.lease_epoch for other in others):
        state.leases.remember_ended(ref, origin.run_id)
        return False
    for other in others:
        revoke(state, other, f"{worker.worker_id} holds a later lease")
    if record.phase is DispatchPhase.PENDING:
        state.queues.take(record)
    if state.awaited.pop(record.key, None) is not None:
        state.awaited_scenes[record.scene] -= 1
        if not state.awaited_scenes[record.scene]:
            del state.awaited_scenes[record.scene]
    record.attempts = max(record.attempts, origin.attempt - 1)
    state.log(RolloutStepKind.LEASED, record.key, worker.worker_id, "adopted from a former manager")
    state.leases.enter(ref, record, worker, state.now_s)
    return True
