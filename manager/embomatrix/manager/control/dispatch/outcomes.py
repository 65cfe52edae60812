"""Outcomes of rollouts, and the consequences for their groups and batches."""

from collections.abc import Mapping

from embomatrix.manager.control.commands import DeliverResult, FinishBatch
from embomatrix.manager.control.dispatch.batches import failed_with
from embomatrix.manager.control.dispatch.leasing import enqueue, queue_rollouts, revoke
from embomatrix.manager.control.dispatch.records import (
    BatchRecord,
    DispatchPhase,
    GroupRecord,
    LeaseRecord,
    RolloutKey,
    RolloutRecord,
)
from embomatrix.manager.control.dispatch.state import AuditCase, DispatchState
from embomatrix.rpc.wire.run_log import RolloutStepKind
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    GroupPolicy,
    InfraFailure,
    Outcome,
    RolloutResult,
)

CANCELLED = Cancelled("the trainer called it off")


def open_batch(state: DispatchState, batch: Batch, delivered: Mapping[str, int]) -> BatchRecord | None:
    """Open a batch without queueing its rollouts; None for a known one."""
    key = (batch.run_id, batch.batch_id)
    if key in state.batches:
        return None
    scenes = dict.fromkeys(rollout.bundle_digest for rollout in batch.rollouts)
    run = state.runs.of(batch.run_id)
    due_s = state.now_s + (run.terms.rollout_deadline_s or state.limits.rollout_deadline_s)
    warm = {scene: state.pool.has_warm(scene) for scene in scenes}
    opened = state.batches.open(
        batch, delivered, now_s=state.now_s, due_s=due_s, warm=warm, reward=run.terms.reward
    )
    state.log(
        RolloutStepKind.SUBMITTED,
        RolloutKey(*key, ""),
        reason=f"in a batch of {batch.count} rollouts",
    )
    run.submitted += opened.whole.left
    if not opened.whole.left:
        _close(state, opened)
    return opened


def queue_next(state: DispatchState, batch: BatchRecord | None, count: int | None) -> None:
    """Queue the next ``count`` rollouts of an open batch that are still coming, or all."""
    if batch is not None:
        queue_rollouts(state, state.batches.admit(batch, count))


def cancel_batch(state: DispatchState, key: tuple[str, str]) -> None:
    batch = state.batches.get(key)
    if batch is not None:
        state.batches.admit(batch)
        for record in list(batch.open.values()):
            _conclude(state, record, CANCELLED)


def deliver(state: DispatchState, record: RolloutRecord, outcome: Outcome) -> None:
    """Give a rollout its one outcome. A lost rollout takes others with it, as the run's group policy says."""
    batch = state.batches.of(record)
    group = batch.groups[record.rollout.group_id]
    _conclude(state, record, outcome)
    if isinstance(outcome, InfraFailure):
        policy = state.policy_of(record)
        _fail_group(state, batch, group, policy, f"rollout {record.key.rollout_id} was lost: {outcome.code}")


def end_and_requeue(state: DispatchState, lease: LeaseRecord, why: str) -> None:
    """End a lease without a result; queue the rollout again unless another lease of it is live."""
    record = lease.record
    state.log(RolloutStepKind.RETURNED, record.key, lease.worker_id, why)
    state.end_lease(lease)
    requeue(state, record)


def requeue(state: DispatchState, record: RolloutRecord) -> None:
    """Queue a rollout again that lost a lease, unless it has another one or waits for an audit."""
    if record.leases or record.held:
        return
    if record.check:
        case = state.cases.get(record.key)
        # A check that can wait gets its next idle slot at a tick.
        if case is not None and case.check is record and case.held is not None:
            queue_rollouts(state, [record])
        return
    state.runs.of(record.key.run_id).counters.redispatched += 1
    state.log(RolloutStepKind.QUEUED, record.key, reason=f"again; failed attempts: {record.attempts}")
    enqueue(state, record)


def close_case(state: DispatchState, case: AuditCase) -> None:
    """End an audit case and its check, wherever the check is."""
    if state.cases.pop(case.key, None) is not None:
        first = state.pool.workers.get(case.opinions[0].worker_id)
        if first is not None and first.unconfirmed:
            first.unconfirmed -= 1
    for worker_id in case.disputed:
        state.auditor.of(worker_id).disputed -= 1
    case.disputed = ()
    if case.check.phase is DispatchPhase.PENDING:
        state.queues.uncount(case.check)
    for lease in list(case.check.leases):
        revoke(state, lease, "its audit ended")
    case.check.phase = DispatchPhase.DONE


def _conclude(state: DispatchState, record: RolloutRecord, outcome: Outcome) -> None:
    if record.phase is DispatchPhase.PENDING:
        state.queues.uncount(record)
    for lease in list(record.leases):
        revoke(state, lease, "the rollout has its outcome")
    if record.held:
        record.held = False
        case = state.cases.get(record.key)
        if case is not None:
            case.held = None
            close_case(state, case)
    batch = state.batches.of(record)
    cursor = state.batches.conclude(record)
    counters = state.runs.of(record.key.run_id).counters
    count, also = record.count, record.rollout.also
    counters.delivered += count
    counters.infra_failures += count * isinstance(outcome, InfraFailure)
    if isinstance(outcome, Completed):
        steps = len(outcome.steps)
        counters.steps += count * steps
        counters.shared_steps += (count - 1) * steps + outcome.shared_steps
    state.log(RolloutStepKind.DELIVERED, record.key, reason=type(outcome).__name__)
    for name in also:
        key = record.key._replace(rollout_id=name)
        state.log(RolloutStepKind.DELIVERED, key, reason=f"with {record.key.rollout_id}, whose plan is equal")
    result = RolloutResult(
        record.key.rollout_id, record.rollout.group_id, cursor, max(record.attempts, 1), outcome, also
    )
    state.emit(DeliverResult(batch.run_id, batch.batch_id, result))
    if not batch.whole.left:
        _close(state, batch)


def _fail_group(
    state: DispatchState, batch: BatchRecord, group: GroupRecord, policy: GroupPolicy, why: str
) -> None:
    run = state.runs.of(batch.run_id)
    late = state.batches.admit(batch)
    failed, lost = failed_with(policy, batch, group)
    for one in failed:
        run.counters.groups_failed += not one.failed
        one.failed = True
    for record in lost:
        _conclude(state, record, Cancelled(why))
    queue_rollouts(state, [record for record in late if record.phase is not DispatchPhase.DONE])


def _close(state: DispatchState, batch: BatchRecord) -> None:
    state.batches.close(batch)
    state.emit(FinishBatch(batch.run_id, batch.batch_id))
