"""Audits: an audited result is compared with a second execution on another worker, and with a third on a mismatch.

A check is a separate rollout record outside all batches. Its worker cannot distinguish it from any other rollout. In a
run that requests verified results, and for workers on probation, the check is queued and the result is held back.
Otherwise the check gets an idle slot after the delivery.
"""

from itertools import islice
from typing import Final

from embomatrix.manager.control.commands import CancelLease, QuarantineWorker
from embomatrix.manager.control.dispatch.leasing import (
    grant,
    offer_scene,
    queue_rollouts,
    revoke,
    with_free_slot_for,
)
from embomatrix.manager.control.dispatch.outcomes import close_case, deliver, end_and_requeue
from embomatrix.manager.control.dispatch.records import LeaseRecord, RolloutRecord
from embomatrix.manager.control.dispatch.state import AuditCase, DispatchState
from embomatrix.manager.control.reputation import OPINIONS, judge, opinion_of
from embomatrix.manager.control.workers import WorkerRecord
from embomatrix.rpc.wire.run_log import RolloutStepKind
from embomatrix.rpc.wire.values import Completed, InfraCode, InfraFailure, Outcome

NOT_CONFIRMED: Final = "the second execution that should have confirmed the result was cancelled"
EXAMINED_PER_TICK: Final = 256
"""Audits examined at each tick, in rotation."""


def finish(state: DispatchState, record: RolloutRecord, outcome: Outcome) -> None:
    """Deliver the outcome of a rollout, or use the outcome of a check to decide its case."""
    if record.check:
        _check_ended(state, record, outcome)
    else:
        deliver(state, record, outcome)


def hold_for_audit(state: DispatchState, lease: LeaseRecord, completed: Completed) -> bool:
    """Open an audit case if the result is to be audited; True if the result is held back meanwhile."""
    record, worker_id = lease.record, lease.worker_id
    if record.held:
        return True  # the case of its other lease decides
    auditor = state.auditor
    verified = state.runs.of(record.key.run_id).terms.verified
    if not auditor.wants(worker_id, lease.ref.lease_id, verified=verified):
        return False
    # A newcomer could answer faster than it is audited, and leave.
    verified |= auditor.on_probation(worker_id)
    if record.key in state.cases or (not verified and len(state.cases) >= auditor.rules.backlog):
        return False
    check = _make_check(state, record, frozenset({worker_id}))
    if not _can_execute(state, check):
        auditor.lone = True
        return False
    auditor.lone = False
    auditor.took(worker_id)
    opinion = opinion_of(worker_id, state.pool.workers[worker_id].resources.versions, completed)
    case = AuditCase(
        record.key, record if verified else None, check, [opinion], [completed] if verified else []
    )
    state.cases[case.key] = case
    state.pool.workers[worker_id].unconfirmed += 1
    record.held = verified
    if verified:
        state.log(RolloutStepKind.HELD, record.key, worker_id, "another worker checks the result")
        for other in list(record.leases):
            revoke(state, other, "another lease brought a result")
        queue_rollouts(state, [check])
    return verified


def drop_run(state: DispatchState, run_id: str) -> None:
    """End the audits of a closed run."""
    for case in [case for case in state.cases.values() if case.key.run_id == run_id]:
        close_case(state, case)


def restore_quarantine(state: DispatchState, worker: WorkerRecord) -> None:
    """Apply the worker's reputation from earlier sessions."""
    worker.quarantined = bool(state.auditor.of(worker.worker_id).quarantine)
    note_probation(state, worker.worker_id)
    state.pool.update_standing(worker)


def note_probation(state: DispatchState, worker_id: str) -> None:
    """Limit the leases of a worker on probation, or end the limit."""
    worker, rules = state.pool.workers.get(worker_id), state.auditor.rules
    if worker is not None:
        limited = rules.background and state.auditor.on_probation(worker_id)
        worker.most_unconfirmed = rules.unconfirmed if limited else None


def tick_audits(state: DispatchState) -> None:
    """Give idle slots to checks that can wait, and end cases that no worker could check for long enough."""
    some = list(islice(state.cases.items(), EXAMINED_PER_TICK))
    for key, case in some:
        del state.cases[key]
        state.cases[key] = case
    for _, case in some:
        if case.check.leases or state.cases.get(case.key) is not case:
            continue
        if _can_execute(state, case.check):
            case.alone_s = None
            if case.held is None:
                _use_idle_slot(state, case.check)
            continue
        case.alone_s = state.now_s if case.alone_s is None else case.alone_s
        if state.now_s - case.alone_s < state.auditor.rules.timeout_s:
            continue
        if len(case.opinions) > 1:
            _end_in_mismatch(state, case)
        else:
            # No worker can compare: the single result is accepted.
            state.auditor.lone = True
            _close_and_deliver(state, case, case.results[0] if case.results else None)


def _check_ended(state: DispatchState, check: RolloutRecord, outcome: Outcome) -> None:
    case = state.cases.get(check.key)
    if case is None or case.check is not check:
        return
    if not isinstance(outcome, Completed):
        if len(case.opinions) > 1:
            _end_in_mismatch(state, case)
        else:
            failed = isinstance(outcome, InfraFailure)
            _close_and_deliver(
                state, case, outcome if failed else InfraFailure(InfraCode.DEADLINE, NOT_CONFIRMED)
            )
        return
    versions = state.pool.workers[outcome.worker_id].resources.versions
    case.opinions.append(opinion_of(outcome.worker_id, versions, outcome))
    if case.held is not None:
        case.results.append(outcome)
    _rule(state, case)


def _rule(state: DispatchState, case: AuditCase) -> None:
    """Decide the case by its opinions, or ask a further worker."""
    verdict = judge(case.opinions)
    if verdict is not None:
        _count(state, case, mismatch=len(case.opinions) > 2)
        for at in verdict.right:
            state.auditor.agreed(case.opinions[at].worker_id)
            note_probation(state, case.opinions[at].worker_id)
        _close_and_deliver(state, case, case.results[verdict.right[0]] if case.results else None)
        for at in verdict.wrong:
            _convict(state, case.opinions[at].worker_id, case)
    elif len(case.opinions) >= OPINIONS:
        _end_in_mismatch(state, case)
    else:
        case.disputed = tuple(opinion.worker_id for opinion in case.opinions)
        for worker_id in case.disputed:
            state.auditor.of(worker_id).disputed += 1
        case.check = _make_check(state, case.check, frozenset(case.disputed))
        case.alone_s = None
        if case.held is not None:
            queue_rollouts(state, [case.check])


def _convict(state: DispatchState, worker_id: str, case: AuditCase) -> None:
    others = " and ".join(o.worker_id for o in case.opinions if o.worker_id != worker_id)
    reason = f"its result of rollout {case.key.rollout_id} of run {case.key.run_id} contradicts {others}"
    quarantine(state, worker_id, reason)


def quarantine(state: DispatchState, worker_id: str, reason: str) -> None:
    """Quarantine a worker, and re-dispatch its rollouts without a confirmed result."""
    known = state.auditor.of(worker_id).quarantine
    state.auditor.convict(worker_id, known or reason)
    if known:
        return  # a second wrong result that was under way
    state.emit(QuarantineWorker(worker_id, reason, state.auditor.of(worker_id).audited))
    worker = state.pool.workers.get(worker_id)
    if worker is not None:
        # First, so that it gets none of the rollouts that are queued again.
        worker.quarantined = True
        state.pool.update_standing(worker)
    again = [other for other in state.cases.values() if other.opinions[0].worker_id == worker_id]
    for other in again:
        held = other.held
        close_case(state, other)
        if held is not None:
            held.held = False
            state.runs.of(other.key.run_id).counters.redispatched += 1
            state.log(RolloutStepKind.QUEUED, held.key, reason=f"again, because {worker_id} is in quarantine")
            queue_rollouts(state, [held])
    if worker is not None:
        leases = list(worker.held.values())
        for lease in leases:
            state.emit(CancelLease(worker_id, lease.ref))
            end_and_requeue(state, lease, "its worker is in quarantine")
        for scene in dict.fromkeys(lease.record.scene for lease in leases):
            offer_scene(state, scene)


def _end_in_mismatch(state: DispatchState, case: AuditCase) -> None:
    """End a case undecided: a held rollout fails, and no worker is blamed."""
    _count(state, case, mismatch=True)
    names = ", ".join(opinion.worker_id for opinion in case.opinions)
    message = f"{names} returned different results, and no third worker agrees with one of them"
    _close_and_deliver(state, case, InfraFailure(InfraCode.RESULT_MISMATCH, message))


def _close_and_deliver(state: DispatchState, case: AuditCase, outcome: Outcome | None) -> None:
    """Close the case, and deliver the outcome of a rollout that was held back."""
    held = case.held
    close_case(state, case)
    if held is not None and outcome is not None:
        held.held = False
        deliver(state, held, outcome)


def _count(state: DispatchState, case: AuditCase, *, mismatch: bool) -> None:
    counters = state.runs.of(case.key.run_id).counters
    counters.audited += 1
    counters.audit_mismatches += mismatch


def _make_check(state: DispatchState, record: RolloutRecord, excluded: frozenset[str]) -> RolloutRecord:
    if record.rollout.is_turn:
        # Only an equal platform reproduces the digest of its prefix.
        excluded |= _of_other_platforms(state, min(excluded))
    return RolloutRecord(
        key=record.key,
        rollout=record.rollout,
        sequence=record.sequence,
        submitted_s=state.now_s,
        warm=record.warm,
        check=True,
        excluded_workers=excluded,
        reward=record.reward,
    )


def _of_other_platforms(state: DispatchState, worker_id: str) -> frozenset[str]:
    workers = state.pool.workers
    known = workers[worker_id].resources.versions if worker_id in workers else {}
    return frozenset(name for name, worker in workers.items() if worker.resources.versions != known)


def _can_execute(state: DispatchState, check: RolloutRecord) -> bool:
    """True if some worker may execute the check, now or later."""
    queue = check.queue
    return any(
        name not in queue.excluded_workers
        and not (worker.quarantined or worker.draining)
        and (worker.render_slots > 0 or not queue.render)
        for name, worker in state.pool.workers.items()
    )


def _use_idle_slot(state: DispatchState, check: RolloutRecord) -> None:
    worker = state.pool.least_busy(check.scene, with_free_slot_for(state, check))
    if worker is not None and not state.paused and not state.queues.count(check.scene):
        grant(state, check, worker, "audit on an idle slot")
