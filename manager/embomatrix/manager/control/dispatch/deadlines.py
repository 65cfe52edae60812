"""Time limits: expired and stalled leases, overdue batches, and rollouts that wait too long for a worker."""

from collections.abc import Mapping
from typing import Final

from embomatrix.manager.control.dispatch.audits import finish, tick_audits
from embomatrix.manager.control.dispatch.lease_results import fail_unloadable_scene, revoke_failed_lease
from embomatrix.manager.control.dispatch.leasing import fill_workers, hedge_late
from embomatrix.manager.control.dispatch.membership import release_awaited
from embomatrix.manager.control.dispatch.records import LeaseRecord
from embomatrix.manager.control.dispatch.state import DispatchState
from embomatrix.manager.control.events import LeasesRenewed
from embomatrix.rpc.wire.run_log import RolloutStepKind
from embomatrix.rpc.wire.values import InfraCode, InfraFailure

STALL_TIMES: Final = 5.0
"""A lease has stalled after this multiple of the 99th percentile of its run's slot times without a step."""


def renew_leases(state: DispatchState, event: LeasesRenewed) -> None:
    """Renew the leases of a heartbeat, and revoke those that make no progress: a worker that is alive may be stuck.

    A lease that should run by the manager's reckoning and reports no progress counts as one without a step.
    """
    state.leases.note_progress(event.worker_id, event.progress, state.now_s)
    for lease in state.leases.renew(event.worker_id, event.held, state.now_s):
        if lease.started_s is None:
            continue
        still_s = state.now_s - max(lease.started_s, lease.moved_s)
        if still_s >= _stall_after_s(state, lease):
            text = f"{event.worker_id} did no step for {still_s:.0f} s, after {max(lease.steps, 0)}"
            revoke_failed_lease(
                state, lease, InfraFailure(InfraCode.STALLED, text, event.worker_id), started=True
            )


def tick(state: DispatchState) -> None:
    """Apply every limit that the passing of time alone reaches."""
    release_awaited(state)
    # Ending a lease starts the next one behind its slot: a lease that expires now counts only if it ran before.
    expired = [(lease, lease.started_s is not None) for lease in state.leases.take_expired(state.now_s)]
    for lease, started in expired:
        _expire(state, lease, started=started)
    for record, had_s in state.batches.overdue(state.now_s):
        failure = InfraFailure(InfraCode.DEADLINE, f"no outcome within {had_s:g} s of its submission")
        finish(state, record, failure)
    state.load_failures.forget_old(state.now_s)
    for scene in state.load_failures.scenes():
        fail_unloadable_scene(state, scene)
    _fail_unplaceable(state)
    _fill_idle(state)
    hedge_late(state)
    tick_audits(state)


def note_unplaceable(state: DispatchState, reasons: Mapping[str, str]) -> None:
    """Replace the set of scenes that no worker can hold."""
    known = state.unplaceable
    state.unplaceable = {
        scene: (known[scene][0] if scene in known else state.now_s, text) for scene, text in reasons.items()
    }


def _stall_after_s(state: DispatchState, lease: LeaseRecord) -> float:
    usual_s = state.runs.of(lease.record.key.run_id).times.quantile_s(0.99)
    if usual_s is None:
        return state.limits.first_stall_s
    return max(state.limits.stall_after_s, STALL_TIMES * usual_s)


def _expire(state: DispatchState, lease: LeaseRecord, *, started: bool) -> None:
    if lease.expires_s <= state.now_s:
        message = f"{lease.worker_id} did not renew the lease for {state.limits.lease_ttl_s:g} s"
    else:
        message = f"{lease.worker_id} gave no result within {state.limits.lease_limit_s:g} s"
    if lease in lease.record.leases:
        state.log(RolloutStepKind.EXPIRED, lease.record.key, lease.worker_id, message)
    failure = InfraFailure(InfraCode.LEASE_EXPIRED, message, lease.worker_id)
    revoke_failed_lease(state, lease, failure, started=started)


def _fail_unplaceable(state: DispatchState) -> None:
    """Fail rollouts that have waited too long while no worker was live, or none that could hold their scene."""
    limit_s = state.limits.no_capacity_s
    if state.pool.live_count or state.paused:
        state.no_worker_since_s = state.now_s
        for scene, (since_s, text) in list(state.unplaceable.items()):
            if state.now_s - since_s >= limit_s:
                _fail_waiting(state, scene, text)
    elif state.now_s - state.no_worker_since_s >= limit_s:
        count = len(state.pool.workers)
        present = f"{count} are paused, draining or silent" if count else "none is there"
        text = f"no worker took work for {limit_s:g} s, {present}: start one with `embomatrix worker run`"
        for scene in state.queues.counts():
            _fail_waiting(state, scene, text)


def _fail_waiting(state: DispatchState, scene: str, text: str) -> None:
    """Fail those rollouts of the scene that have waited for the whole limit; later ones keep waiting."""
    while (record := state.queues.oldest(scene)) is not None:
        if state.now_s - record.submitted_s < state.limits.no_capacity_s:
            return
        finish(state, record, InfraFailure(InfraCode.NO_CAPACITY, text))


def _fill_idle(state: DispatchState) -> None:
    """Fill free slots again: the end of a penalty or of an avoidance makes a waiting rollout acceptable."""
    pool = state.pool
    # One live worker has no other to be slower than.
    cleared = pool.clear_lags() if pool.live_count <= 1 else []
    if state.queues.scene_count or pool.has_backlog:
        fill_workers(state, [*cleared, *pool.rotate_idle(), *pool.lags])
