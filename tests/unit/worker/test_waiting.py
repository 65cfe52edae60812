"""Order of waiting leases: few processes are forked, and no lease starves."""

import pytest

from embomatrix.rpc.wire.leases import Lease, LeaseRef
from embomatrix.rpc.wire.values import ResidentState, Rollout
from embomatrix.worker.slots.execution import HeldLease
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
        leases.add(HeldLease(lease, 0.0, True))
    return leases


def taken(waiting, now_s):
    found = waiting.take(now_s)
    return found and found[0].lease.ref.lease_id


def test_free_slot_takes_the_first_scene_that_needs_no_fork(waiting, scenes):
    assert taken(waiting, 0.1) == "l0"
    scenes["kitchen"].running = 1
    assert taken(waiting, 0.1) == "l2"
    scenes["bath"].running = 1
    assert taken(waiting, 0.1) == "l3"


def test_first_lease_is_next_if_every_scene_needs_a_fork(waiting, scenes):
    for scene in scenes.values():
        scene.running = 1
    assert [taken(waiting, 0.1) for _ in range(5)] == ["l0", "l1", "l2", "l3", None]


def test_lease_that_has_waited_long_is_not_overtaken(waiting, scenes):
    scenes["kitchen"].running = 1
    assert taken(waiting, OVERTAKEN_S + 0.1) == "l0"


def test_leases_of_cold_scenes_are_skipped(waiting, scenes):
    del scenes["kitchen"]
    assert [taken(waiting, OVERTAKEN_S + 0.1) for _ in range(3)] == ["l2", "l3", None]
