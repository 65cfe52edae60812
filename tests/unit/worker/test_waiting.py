"""Which of the leases that wait is a slot's next: few processes are forked, and nobody waits for ever."""

import pytest

from embomatrix.rpc.wire.leases import Lease, LeaseRef
from embomatrix.rpc.wire.values import ResidentState, Rollout
from embomatrix.worker.slots.execution import Ticket
from embomatrix.worker.slots.residents import ResidentScene
from embomatrix.worker.slots.waiting import OVERTAKEN_S, WaitingLeases

SCENES = ("kitchen", "bath", "hall")


@pytest.fixture
def scenes():
    return {digest: ResidentScene(digest, ResidentState.WARM) for digest in SCENES}


@pytest.fixture
def waiting(scenes):
    leases = WaitingLeases(2, scenes.get)
    for number, digest in enumerate(("kitchen", "kitchen", "bath", "hall")):
        lease = Lease(LeaseRef(f"l{number}", 1), Rollout(f"l{number}", "g", digest, "t", (), 1), 10.0)
        leases.add(Ticket(lease, 0.0, True))
    return leases


def taken(waiting, now_s):
    found = waiting.take(now_s)
    return found and found[0].lease.ref.lease_id


def test_a_free_slot_goes_to_the_first_scene_in_which_none_is_at_work(waiting, scenes):
    assert taken(waiting, 0.1) == "l0"
    scenes["kitchen"].running = 1
    assert taken(waiting, 0.1) == "l2"
    scenes["bath"].running = 1
    assert taken(waiting, 0.1) == "l3"


def test_where_all_scenes_are_at_work_the_first_lease_is_next(waiting, scenes):
    for scene in scenes.values():
        scene.running = 1
    assert [taken(waiting, 0.1) for _ in range(5)] == ["l0", "l1", "l2", "l3", None]


def test_a_lease_that_has_waited_for_long_is_overtaken_by_none(waiting, scenes):
    scenes["kitchen"].running = 1
    assert taken(waiting, OVERTAKEN_S + 0.1) == "l0"


def test_a_scene_that_is_not_warm_is_passed_over(waiting, scenes):
    del scenes["kitchen"]
    assert [taken(waiting, OVERTAKEN_S + 0.1) for _ in range(3)] == ["l2", "l3", None]
