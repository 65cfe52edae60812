"""Worker pool of a large cluster: lookups by scene, free slots and backlog scan only some of the workers."""

import pytest

from embomatrix.manager.control.dispatch.records import LeaseRecord, RolloutKey, RolloutRecord
from embomatrix.manager.control.workers import AHEAD_S, BEHIND, CANDIDATES, SEEKERS, WorkerPool
from embomatrix.rpc.wire.leases import LeaseRef
from embomatrix.rpc.wire.values import Resources, Rollout

MANY = 3 * CANDIDATES


def has_credit(worker):
    return worker.open_credits > 0


def pool_of(count, scene="kitchen"):
    """Return a pool of workers with one slot each and the scene warm."""
    pool = WorkerPool()
    for index in range(count):
        pool.join(f"w{index:04d}", Resources(1, 1, 1024))
        worker = pool.workers[f"w{index:04d}"]
        worker.reported = True
        pool.update_standing(worker)
        pool.set_warm(worker, [scene])
    return pool


def load(pool, worker_id, leases, given_s=0.0):
    worker = pool.workers[worker_id]
    for _ in range(leases):
        name = f"{worker_id}.{len(worker.held)}"
        rollout = Rollout(name, "g", "kitchen", "t", (), 0)
        record = RolloutRecord(RolloutKey("r", "b", name), rollout, 0, 0.0, True)
        pool.add_lease(worker, LeaseRecord(LeaseRef(name, 1), worker_id, record, given_s, 30.0, 180.0))


def test_only_worker_with_a_credit_is_found_among_many():
    pool = pool_of(MANY)
    for worker_id in list(pool.workers)[:-1]:
        load(pool, worker_id, 2)
    assert pool.least_busy("kitchen", has_credit).worker_id == f"w{MANY - 1:04d}"
    load(pool, f"w{MANY - 1:04d}", 2)
    assert pool.least_busy("kitchen", has_credit) is None


def test_all_of_many_holders_get_leases():
    pool = pool_of(MANY)
    chosen = []
    for _ in range(MANY):
        chosen.append(pool.least_busy("kitchen", has_credit).worker_id)
        load(pool, chosen[-1], 1)
    assert len(set(chosen)) == MANY


def test_idle_worker_finds_a_lease_behind_a_busy_slot():
    pool = pool_of(2)
    load(pool, "w0000", 2, given_s=1.0)
    thief = pool.workers["w0001"]
    assert pool.rotate_idle() == ["w0001"]
    assert pool.stealable_lease(thief, before_s=0.5, now_s=2.0) is None
    assert pool.stealable_lease(thief, before_s=1.0, now_s=2.0).ref.lease_id == "w0000.1"


@pytest.mark.parametrize(
    ("now_s", "left_alone"),
    # Three rollouts of 0.1 s each; the first began at 1 s, so the last begins at 1.2 s.
    [(1.05, False), (1.15, True), (1.2, True), (1.39, True), (1.41, False)],
)
def test_lease_about_to_start_is_not_stolen(now_s, left_alone):
    pool = pool_of(2)
    pool.workers["w0000"].note_completed(0.1)
    load(pool, "w0000", 3, given_s=1.0)
    found = pool.stealable_lease(pool.workers["w0001"], before_s=1.0, now_s=now_s)
    assert (found is None) == left_alone


def test_next_start_is_predicted_from_the_slot_that_started_last():
    pool = pool_of(1)
    thief, victim = pool.workers["w0000"], pool.join("twice", Resources(2, 2, 1024))
    victim.note_completed(0.1)
    load(pool, "twice", 1, given_s=1.0)
    load(pool, "twice", 2, given_s=3.0)
    victim.reported = True
    assert pool.stealable_lease(thief, before_s=3.0, now_s=3.1) is None
    assert pool.stealable_lease(thief, before_s=3.0, now_s=3.5).ref.lease_id == "twice.2"


def test_lease_is_not_stolen_while_the_slot_that_started_first_ends():
    pool = pool_of(1)
    thief, victim = pool.workers["w0000"], pool.join("twice", Resources(2, 2, 1024))
    victim.note_completed(0.3)
    load(pool, "twice", 1, given_s=1.0)
    load(pool, "twice", 2, given_s=1.29)  # the other slot has just begun
    victim.reported = True
    assert pool.stealable_lease(thief, before_s=1.3, now_s=1.3) is None
    assert pool.stealable_lease(thief, before_s=1.3, now_s=1.8).ref.lease_id == "twice.2"


def test_idle_workers_are_rotated():
    pool = pool_of(2 * SEEKERS + 1)
    load(pool, "w0000", 2)
    first, second = pool.rotate_idle(), pool.rotate_idle()
    assert len(set(first) | set(second)) == 2 * SEEKERS


def test_draining_or_suspected_worker_is_neither_live_nor_idle():
    pool = pool_of(3)
    pool.workers["w0000"].drained = True
    pool.workers["w0001"].suspect = True
    for worker in pool.workers.values():
        pool.update_standing(worker)
    assert pool.live_count == 1
    assert pool.idle == {"w0002"}
    pool.leave("w0002")
    assert (pool.live_count, pool.idle) == (0, frozenset())


def test_credits_follow_the_pace_of_a_worker():
    pool = pool_of(1)
    worker = pool.workers["w0000"]
    assert worker.credits == 2
    worker.note_completed(AHEAD_S / 10)
    assert worker.credits == 11
    for _ in range(200):
        worker.note_completed(1e-6)
    assert worker.credits == 1 + BEHIND
    for _ in range(200):
        worker.note_completed(10 * AHEAD_S)
    assert worker.credits == 2
