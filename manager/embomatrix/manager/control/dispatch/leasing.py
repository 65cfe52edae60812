"""Granting of leases: to warm workers, to freed slots, by stealing, and as hedges of late rollouts."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Final

from embomatrix.manager.control.commands import CancelLease, GiveLease
from embomatrix.manager.control.dispatch.leases import origin_of
from embomatrix.manager.control.dispatch.records import LeaseRecord, RolloutRecord
from embomatrix.manager.control.dispatch.state import DispatchState
from embomatrix.manager.control.workers import WorkerRecord
from embomatrix.rpc.wire.run_log import RolloutStepKind

EXAMINED_PER_TICK: Final = 256
"""Rollouts of tails examined for hedging at each tick, in rotation."""
SLOW: Final = 2.0
"""A lease is late after this multiple of the 95th percentile of its run's slot times."""


def queue_rollouts(state: DispatchState, records: Sequence[RolloutRecord]) -> None:
    """Queue the rollouts and lease them to workers that have their scenes warm."""
    for record in records:
        enqueue(state, record)
    for scene in dict.fromkeys(record.scene for record in records):
        offer_scene(state, scene)


def enqueue(state: DispatchState, record: RolloutRecord) -> None:
    if not state.queues.of_run(record.key.run_id):
        state.runs.wake(record.key.run_id)
    state.queues.push(record)


def offer_scene(state: DispatchState, scene: str) -> None:
    """Lease waiting rollouts of the scene to the least busy workers that have it warm."""
    while not state.paused:
        for record in state.queues.heads(scene):
            worker = state.pool.least_busy(scene, _with_credit_for(state, record))
            if worker is not None:
                state.queues.take(record)
                grant(state, record, worker, "least busy worker with the scene warm")
                break
        else:
            return


def fill_workers(state: DispatchState, worker_ids: Iterable[str]) -> None:
    """Lease waiting rollouts of their warm scenes to the workers, in order of turns; idle slots then steal."""
    if state.paused:
        return
    for worker_id in worker_ids:
        worker = state.pool.workers.get(worker_id)
        if worker is None or worker.open_credits <= 0:
            continue
        choice = state.queues.choice(worker, state.now_s)
        while worker.open_credits > 0 and (record := choice.next()) is not None:
            state.queues.take(record)
            grant(state, record, worker, "free credit, scene warm")
        _steal_for(state, worker)


def fill_freed(state: DispatchState) -> None:
    """Use all slots that became free, and those that become free by stealing."""
    while state.freed:
        freed, state.freed = state.freed, {}
        for worker_id, state.cause in freed.items():
            fill_workers(state, (worker_id,))


def grant(
    state: DispatchState, record: RolloutRecord, worker: WorkerRecord, why: str, *, hedge: bool = False
) -> None:
    """Lease a rollout that is in no queue to a worker that takes it."""
    lease = state.leases.grant(record, worker, state.now_s)
    state.log(RolloutStepKind.HEDGED if hedge else RolloutStepKind.LEASED, record.key, worker.worker_id, why)
    state.emit(
        GiveLease(
            worker.worker_id,
            lease.ref,
            record.rollout,
            state.limits.execute_deadline_s,
            origin_of(record),
            hedge,
            record.check,
            record.reward,
        )
    )


def revoke(state: DispatchState, lease: LeaseRecord, why: str) -> None:
    """End a lease that its worker may still hold."""
    state.log(RolloutStepKind.REVOKED, lease.record.key, lease.worker_id, why)
    state.end_lease(lease)
    state.emit(CancelLease(lease.worker_id, lease.ref))


def hedge_late(state: DispatchState) -> None:
    """Lease late rollouts a second time to idle workers with their scene; note the scenes that no such worker has."""
    wanted: dict[str, tuple[int, float]] = {}
    if state.pool.idle and not state.paused:
        for lease in _late_leases(state):
            record = lease.record
            worker = state.pool.least_busy(record.scene, with_free_slot_for(state, record))
            if worker is None:
                count, held_s = wanted.get(record.scene, (0, 0.0))
                wanted[record.scene] = count + 1, max(held_s, state.now_s - lease.given_s)
            elif lease.started_s is not None:
                record.hedged = True
                state.runs.of(record.key.run_id).counters.hedged += 1
                grant(state, record, worker, f"late on {lease.worker_id}", hedge=True)
    state.hedge_wanted = wanted


def with_free_slot_for(state: DispatchState, record: RolloutRecord) -> Callable[[WorkerRecord], bool]:
    return lambda worker: worker.free_slots > 0 and worker.takes(record, state.now_s)


def _with_credit_for(state: DispatchState, record: RolloutRecord) -> Callable[[WorkerRecord], bool]:
    return lambda worker: worker.open_credits > 0 and worker.takes(record, state.now_s)


def _steal_for(state: DispatchState, worker: WorkerRecord) -> None:
    """Move leases that are queued behind busy slots elsewhere. They have not started, so no attempt is lost."""
    before_s = state.now_s - state.limits.steal_after_s
    while worker.free_slots > 0:
        lease = state.pool.stealable_lease(worker, before_s, state.now_s)
        if lease is None:
            return
        revoke(state, lease, f"queued behind a busy slot while {worker.worker_id} is idle")
        grant(state, lease.record, worker, f"stolen from {lease.worker_id}")


def _late_leases(state: DispatchState) -> Iterator[LeaseRecord]:
    """Yield the only leases of late rollouts in tails that may be hedged."""
    for record in _tail_rollouts(state):
        if len(record.leases) != 1 or record.hedged or record.out_of_memory:
            continue
        (lease,) = record.leases
        run = state.runs.of(record.key.run_id)
        usual_s = run.times.quantile_s(0.95)
        if usual_s is None:
            continue
        since_s = lease.given_s if lease.started_s is None else lease.started_s
        late = state.now_s - since_s > max(SLOW * usual_s, state.limits.hedge_after_s)
        if late and run.counters.hedged + 1 <= state.limits.hedge_share * run.submitted:
            yield lease


def _tail_rollouts(state: DispatchState) -> list[RolloutRecord]:
    tails = state.batches.tails
    records: list[RolloutRecord] = []
    for group in list(tails):
        if len(records) >= EXAMINED_PER_TICK:
            break
        records += islice(group.open.values(), EXAMINED_PER_TICK - len(records))
        del tails[group]
        tails[group] = None
    return list(dict.fromkeys(records))
