"""Ends of leases: results and failures that workers report, revoked leases, and scenes that fail to load."""

import dataclasses

from embomatrix.manager.control.commands import AcknowledgeLease, CancelLease
from embomatrix.manager.control.dispatch.audits import finish, hold_for_audit, quarantine
from embomatrix.manager.control.dispatch.leasing import offer_scene
from embomatrix.manager.control.dispatch.outcomes import requeue
from embomatrix.manager.control.dispatch.records import LeaseRecord, RolloutRecord
from embomatrix.manager.control.dispatch.state import DispatchState
from embomatrix.manager.control.events import LeaseFinished
from embomatrix.manager.control.plausibility import contradiction
from embomatrix.rpc.wire.run_log import RolloutStepKind
from embomatrix.rpc.wire.values import Completed, GroupPolicy, InfraCode, InfraFailure
from embomatrix.skills.turns import TurnObservation


def settle_result(state: DispatchState, event: LeaseFinished) -> None:
    """Acknowledge a reported result, and use it if its lease is live. Any other result is stale and dropped.

    A worker with an impossible result is put in quarantine.
    """
    state.emit(AcknowledgeLease(event.worker_id, event.ref))
    lease = state.leases.find(event.worker_id, event.ref)
    if lease is None:
        run_id = state.leases.run_of_ended(event.ref)
        if run_id is not None and run_id in state.runs:
            state.runs.of(run_id).counters.stale_results += 1
        return
    match event.outcome:
        case Completed(observation=None) if lease.record.rollout.is_turn:
            _fail(state, lease, _outdated(event.worker_id, "turns of episodes"))
        case Completed(observation=TurnObservation(looked=False)) if lease.record.rollout.sight:
            _fail(state, lease, _outdated(event.worker_id, "sight in episodes"))
        case Completed(observation=TurnObservation(advice=None)) if lease.record.rollout.advise:
            _fail(state, lease, _outdated(event.worker_id, "the oracle's advice in episodes"))
        case Completed() as completed:
            wrong = contradiction(completed, lease.record.rollout, lease.record.reward)
            if wrong:
                reason = f"its result of {lease.record.key.rollout_id} is impossible: {wrong}"
                quarantine(state, event.worker_id, reason)
            else:
                _complete(state, lease, completed)
        case InfraFailure() as failure:
            _fail(state, lease, dataclasses.replace(failure, worker_id=event.worker_id))


def _outdated(worker_id: str, lacks: str) -> InfraFailure:
    return InfraFailure(InfraCode.VERSION_SKEW, f"{worker_id} does not know {lacks}: upgrade it", worker_id)


def end_failed_lease(
    state: DispatchState, lease: LeaseRecord, failure: InfraFailure, *, counted: bool
) -> None:
    """End a lease that brought no result. The rollout is queued again, or fails after its last attempt.

    Only ``counted`` ends cost an attempt. A lease that ended with its group a moment ago is left alone.
    """
    record = lease.record
    if lease not in record.leases:
        return
    state.log(RolloutStepKind.RETURNED, record.key, lease.worker_id, failure.message)
    state.end_lease(lease)
    if counted:
        record.attempts += 1
        record.out_of_memory |= failure.code is InfraCode.SLOT_OOM
        if state.pool.live_count > 1:
            record.failed_on = lease.worker_id
            record.avoid_until_s = state.now_s + state.limits.elsewhere_s
    if record.leases or record.held:
        return
    most = _most_attempts(state, record, failure)
    if record.attempts >= most:
        message = f"{failure.message} (attempt {record.attempts} of {most})"
        finish(state, record, dataclasses.replace(failure, message=message))
    else:
        requeue(state, record)


def _most_attempts(state: DispatchState, record: RolloutRecord, failure: InfraFailure) -> int:
    if state.policy_of(record) is GroupPolicy.FAIL_FAST:
        return 1
    if failure.code is InfraCode.PREFIX_MISMATCH:
        # The same worker would find the same; one of another platform may not.
        return 2 if state.pool.live_count > 1 else 1
    return state.limits.max_attempts


def revoke_failed_lease(
    state: DispatchState, lease: LeaseRecord, failure: InfraFailure, *, started: bool
) -> None:
    """Revoke a lease whose worker failed it; another worker gets the rollout."""
    if lease not in lease.record.leases:
        return  # it ended with its group a moment ago
    state.emit(CancelLease(lease.worker_id, lease.ref))
    end_failed_lease(state, lease, failure, counted=started)
    offer_scene(state, lease.record.scene)


def fail_unloadable_scene(state: DispatchState, scene: str) -> None:
    """Fail the waiting rollouts of a scene that no worker can load."""
    if state.pool.has_warm(scene) or not state.queues.count(scene):
        return
    verdict = state.load_failures.verdict(
        scene, live=state.pool.live_count, timeout_s=state.limits.lone_load_failure_s, now_s=state.now_s
    )
    while verdict is not None and (record := state.queues.oldest(scene)) is not None:
        finish(state, record, verdict)


def _complete(state: DispatchState, lease: LeaseRecord, completed: Completed) -> None:
    record = lease.record
    state.end_lease(lease)
    record.attempts += 1
    run = state.runs.of(record.key.run_id)
    state.pool.note_slot_time(lease, run.times, state.now_s, lost=False)
    for other in record.leases:
        state.pool.note_slot_time(other, run.times, state.now_s, lost=True)
    state.pool.workers[lease.worker_id].note_completed(completed.timings.execute_s)
    timings = lease.timings(completed.timings, state.now_s)
    warm = record.warm and completed.warm
    result = completed.noted(timings=timings, warm=warm, worker_id=lease.worker_id)
    if not record.check:
        run.counters.warm_starts += record.count * record.warm
        run.counters.cold_starts += record.count * (not record.warm)
        if hold_for_audit(state, lease, result):
            return
    finish(state, record, result)


def _fail(state: DispatchState, lease: LeaseRecord, failure: InfraFailure) -> None:
    worker, scene = state.pool.workers[lease.worker_id], lease.record.scene
    if failure.code in (InfraCode.SCENE_LOAD_FAILED, InfraCode.BUNDLE_CORRUPT):
        # Not warm until the worker reports again: the rollout would come straight back.
        state.pool.set_warm(worker, worker.warm - {scene})
        state.load_failures.record(scene, worker.worker_id, failure.message, state.now_s)
    end_failed_lease(state, lease, failure, counted=True)
    fail_unloadable_scene(state, scene)
    offer_scene(state, scene)
