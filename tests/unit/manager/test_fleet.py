"""Workers in a large cluster: found by scene, by free slots and by backlog, without looking at all of them."""

import pytest

from embomatrix.manager.control.dispatch.fleet import CANDIDATES, SEEKERS, Fleet
from embomatrix.manager.control.dispatch.ledger import AHEAD_S, BEHIND, LeaseRecord, RolloutKey, RolloutRecord
from embomatrix.rpc.wire.leases import LeaseRef
from embomatrix.rpc.wire.values import Rollout

MANY = 3 * CANDIDATES


def fleet_of(count, scene="kitchen"):
    """So many workers with one slot each, all with the scene warm."""
    fleet = Fleet()
    for index in range(count):
        fleet.join(f"w{index:04d}", 1)
        worker = fleet.workers[f"w{index:04d}"]
        worker.reported = True
        fleet.stand(worker)
        fleet.set_warm(worker, [scene])
    return fleet


def load(fleet, worker_id, leases, given_s=0.0):
    worker = fleet.workers[worker_id]
    for _ in range(leases):
        name = f"{worker_id}.{len(worker.held)}"
        rollout = Rollout(name, "g", "kitchen", "t", (), 0)
        record = RolloutRecord(RolloutKey("r", "b", name), rollout, 0, 0.0, True)
        fleet.hold(worker, LeaseRecord(LeaseRef(name, 1), worker_id, record, given_s, 30.0, 180.0))


def test_the_only_one_of_many_holders_with_a_credit_is_found():
    fleet = fleet_of(MANY)
    for worker_id in list(fleet.workers)[:-1]:
        load(fleet, worker_id, 2)
    assert fleet.best_for("kitchen").worker_id == f"w{MANY - 1:04d}"
    load(fleet, f"w{MANY - 1:04d}", 2)
    assert fleet.best_for("kitchen") is None


def test_all_of_many_holders_get_their_turn():
    fleet = fleet_of(MANY)
    chosen = []
    for _ in range(MANY):
        chosen.append(fleet.best_for("kitchen").worker_id)
        load(fleet, chosen[-1], 1)
    assert len(set(chosen)) == MANY


def test_an_idle_worker_finds_a_lease_behind_a_busy_slot():
    fleet = fleet_of(2)
    load(fleet, "w0000", 2, given_s=1.0)
    thief = fleet.workers["w0001"]
    assert fleet.seekers() == ["w0001"]
    assert fleet.waiting_behind(thief, before_s=0.5, now_s=2.0) is None
    assert fleet.waiting_behind(thief, before_s=1.0, now_s=2.0).ref.lease_id == "w0000.1"


@pytest.mark.parametrize(
    ("now_s", "left_alone"),
    # Three rollouts of 0.1 s each, of which the first began at 1 s: the last begins at 1.2 s.
    [(1.05, False), (1.15, True), (1.2, True), (1.39, True), (1.41, False)],
)
def test_a_lease_that_is_about_to_begin_behind_its_slot_is_left_to_it(now_s, left_alone):
    fleet = fleet_of(2)
    fleet.workers["w0000"].note_completed(0.1)
    load(fleet, "w0000", 3, given_s=1.0)
    found = fleet.waiting_behind(fleet.workers["w0001"], before_s=1.0, now_s=now_s)
    assert (found is None) == left_alone


def test_of_two_slots_the_one_that_began_last_tells_when_the_next_lease_begins():
    fleet = fleet_of(1)
    thief, victim = fleet.workers["w0000"], fleet.join("twice", 2)
    victim.note_completed(0.1)
    load(fleet, "twice", 1, given_s=1.0)
    load(fleet, "twice", 2, given_s=3.0)
    victim.reported = True
    assert fleet.waiting_behind(thief, before_s=3.0, now_s=3.1) is None
    assert fleet.waiting_behind(thief, before_s=3.0, now_s=3.5).ref.lease_id == "twice.2"


def test_different_idle_workers_look_each_time():
    fleet = fleet_of(2 * SEEKERS + 1)
    load(fleet, "w0000", 2)
    first, second = fleet.seekers(), fleet.seekers()
    assert len(set(first) | set(second)) == 2 * SEEKERS


def test_a_worker_that_drains_or_is_suspected_is_neither_live_nor_idle():
    fleet = fleet_of(3)
    fleet.workers["w0000"].drained = True
    fleet.workers["w0001"].suspect = True
    for worker in fleet.workers.values():
        fleet.stand(worker)
    assert fleet.live == 1
    assert fleet.idle == {"w0002"}
    fleet.leave("w0002")
    assert (fleet.live, fleet.idle) == (0, frozenset())


def test_a_worker_holds_as_many_leases_ahead_as_it_executes_until_others_come():
    fleet = fleet_of(1)
    worker = fleet.workers["w0000"]
    assert worker.credits == 2
    worker.note_completed(AHEAD_S / 10)
    assert worker.credits == 11
    for _ in range(200):
        worker.note_completed(1e-6)
    assert worker.credits == 1 + BEHIND
    for _ in range(200):
        worker.note_completed(10 * AHEAD_S)
    assert worker.credits == 2
