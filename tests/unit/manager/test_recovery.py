"""Takeover by a new manager: claimed leases are adopted, the others are re-dispatched after a grace time."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.worker import completed

from embomatrix.manager.control.commands import (
    AcknowledgeLease,
    CancelLease,
    DeliverResult,
    FinishBatch,
    GiveLease,
)
from embomatrix.manager.control.dispatch.dispatcher import Dispatcher
from embomatrix.manager.control.dispatch.leases import lease_id_of
from embomatrix.manager.control.dispatch.state import DispatchLimits
from embomatrix.manager.control.events import (
    BatchCancelled,
    BatchRestored,
    BatchSubmitted,
    LeaseFinished,
    Tick,
    WorkerJoined,
    WorkerLost,
    WorkerReported,
    WorkersExpected,
)
from embomatrix.rpc.wire.leases import LeaseClaim, LeaseOrigin, LeaseRef
from embomatrix.rpc.wire.values import (
    Batch,
    Resident,
    ResidentState,
    Resources,
    Rollout,
)

GRACE_S = 5.0
FIRST_EPOCH = 1 << 32
KEY = b"secret of the cluster"
WARM = (Resident("kitchen", ResidentState.WARM),)


def batch(count, batch_id="b1"):
    return Batch("r1", batch_id, 1, tuple(Rollout(f"x{i}", "g", "kitchen", "t", (), 0) for i in range(count)))


def claim(rollout_id, epoch=1, attempt=1, batch_id="b1", worker_id="w1", key=KEY):
    """Return the claim of a lease that a former manager gave to this worker, if the key is the cluster's."""
    origin = LeaseOrigin("r1", batch_id, rollout_id, attempt)
    return LeaseClaim(LeaseRef(lease_id_of(key, origin, worker_id, epoch), epoch), origin)


class Successor:
    """Manager that has just taken over a batch, and its clock."""

    def __init__(self, count=2, delivered=(), failures=0):
        limits = DispatchLimits(restart_grace_s=GRACE_S)
        self.dispatcher = Dispatcher(limits, lease_key=KEY, first_epoch=FIRST_EPOCH)
        self.now_s = 100.0
        cursors = {name: number + 1 for number, name in enumerate(delivered)}
        self.first = self.apply(BatchRestored(batch(count), cursors, len(cursors), failures))

    def apply(self, *events, after_s=0.0):
        self.now_s += after_s
        return [command for event in events for command in self.dispatcher.handle(event, now_s=self.now_s)]

    def worker(self, worker_id="w1", *claims, slots=1):
        """Reconnect a worker that reports its held leases."""
        held = tuple(claim.ref for claim in claims)
        return self.apply(
            WorkerJoined(worker_id, Resources(slots, slots, 1024)),
            WorkerReported(worker_id, WARM, held, resync=True, claims=claims),
        )

    def wait_out_the_grace(self):
        return self.apply(Tick(), after_s=GRACE_S)


def kinds(commands, kind):
    return [command for command in commands if isinstance(command, kind)]


def given_to(commands):
    return [(command.worker_id, command.rollout.rollout_id) for command in kinds(commands, GiveLease)]


def test_running_lease_of_a_former_manager_is_adopted_and_its_result_counts():
    successor = Successor(1)
    assert successor.worker("w1", claim("x0")) == []
    assert successor.wait_out_the_grace() == []
    commands = successor.apply(LeaseFinished("w1", claim("x0").ref, completed()))
    assert [command.result.rollout_id for command in kinds(commands, DeliverResult)] == ["x0"]
    assert commands[-1] == FinishBatch("r1", "b1")


def test_unacknowledged_result_counts_when_its_worker_returns():
    successor = Successor(1)
    successor.worker("w1", claim("x0"))
    commands = successor.apply(LeaseFinished("w1", claim("x0").ref, completed()))
    assert kinds(commands, AcknowledgeLease) == [AcknowledgeLease("w1", claim("x0").ref)]
    assert len(kinds(commands, DeliverResult)) == 1


def test_unclaimed_rollouts_are_leased_only_after_the_grace_time():
    successor = Successor(2)
    assert given_to(successor.worker("w1", slots=4)) == []
    assert given_to(successor.apply(Tick(), after_s=GRACE_S - 0.1)) == []
    assert given_to(successor.apply(Tick(), after_s=0.2)) == [("w1", "x0"), ("w1", "x1")]


def test_wait_ends_when_all_expected_workers_have_reported():
    successor = Successor(2)
    successor.apply(WorkersExpected(frozenset({"w1", "w2"})))
    successor.worker("w1", claim("x0"), slots=4)
    assert given_to(successor.apply(Tick(), after_s=0.1)) == []
    successor.worker("w2")
    assert [rollout for _, rollout in given_to(successor.apply(Tick(), after_s=0.1))] == ["x1"]


def test_no_wait_if_no_worker_was_present_before():
    successor = Successor(1)
    successor.apply(WorkersExpected(frozenset()))
    successor.worker("w1")
    assert given_to(successor.apply(Tick(), after_s=0.1)) == [("w1", "x0")]


def test_wait_for_a_missing_worker_ends_after_the_grace_time():
    successor = Successor(1)
    successor.apply(WorkersExpected(frozenset({"w1", "gone"})))
    successor.worker("w1")
    assert given_to(successor.apply(Tick(), after_s=GRACE_S - 0.1)) == []
    assert successor.dispatcher.expected == {"gone"}
    assert given_to(successor.apply(Tick(), after_s=0.2)) == [("w1", "x0")]


def test_batch_submitted_meanwhile_does_not_wait():
    successor = Successor(1)
    successor.worker("w1", slots=4)
    assert given_to(successor.apply(BatchSubmitted(batch(1, "b2")))) == [("w1", "x0")]


def test_scenes_of_awaited_rollouts_are_in_demand():
    demand = Successor(3).dispatcher.demand()
    assert demand.pending == {"kitchen": 3}
    assert demand.waited_s == {"kitchen": 0.0}


def test_later_of_two_claimed_leases_counts():
    for order in (("w1", "w2"), ("w2", "w1")):
        successor = Successor(1)
        claims = {"w1": claim("x0", epoch=5), "w2": claim("x0", epoch=9, worker_id="w2")}
        commands = [command for name in order for command in successor.worker(name, claims[name])]
        assert kinds(commands, CancelLease) == [CancelLease("w1", claims["w1"].ref)]
        late = successor.apply(LeaseFinished("w1", claims["w1"].ref, completed()))
        assert kinds(late, DeliverResult) == []
        assert successor.dispatcher.counters("r1").stale_results == 1
        good = successor.apply(LeaseFinished("w2", claims["w2"].ref, completed()))
        assert len(kinds(good, DeliverResult)) == 1


def test_claim_after_the_rollout_was_redispatched_is_rejected():
    successor = Successor(1)
    successor.worker("w2")
    assert given_to(successor.wait_out_the_grace()) == [("w2", "x0")]
    assert kinds(successor.worker("w1", claim("x0")), CancelLease) == [CancelLease("w1", claim("x0").ref)]


def test_claim_after_the_grace_time_is_refused():
    successor = Successor(1)
    successor.wait_out_the_grace()
    commands = successor.worker("w1", claim("x0"))
    assert kinds(commands, CancelLease) == [CancelLease("w1", claim("x0").ref)]
    assert given_to(commands) == [("w1", "x0")]


def test_claim_is_refused_once_all_expected_workers_are_back():
    successor = Successor(2)
    successor.apply(WorkersExpected(frozenset({"w1"})))
    successor.worker("w1", slots=2)
    successor.apply(Tick(), after_s=0.1)
    late = claim("x0", worker_id="w2")
    assert kinds(successor.worker("w2", late), CancelLease) == [CancelLease("w2", late.ref)]


def test_claim_without_a_restart_is_refused():
    dispatcher = Dispatcher(DispatchLimits(), lease_key=KEY, first_epoch=FIRST_EPOCH)
    dispatcher.handle(BatchSubmitted(batch(1)), now_s=1.0)
    dispatcher.handle(WorkerJoined("w1", Resources(1, 1, 1024)), now_s=1.0)
    forged = claim("x0")
    reported = WorkerReported("w1", WARM, (forged.ref,), resync=True, claims=(forged,))
    commands = dispatcher.handle(reported, now_s=1.0)
    assert kinds(commands, CancelLease) == [CancelLease("w1", forged.ref)]
    assert given_to(commands) == [("w1", "x0")]


@pytest.mark.parametrize(
    "forged",
    [
        claim("x0", key=b"guessed"),
        claim("x0", worker_id="w2"),  # given to another worker
        LeaseClaim(claim("x0").ref, claim("x1").origin),  # given for another rollout
        LeaseClaim(claim("x0").ref, LeaseOrigin("r1", "b1", "x0", attempt=4294967295)),
        LeaseClaim(LeaseRef(claim("x0").ref.lease_id, 2), claim("x0").origin),
        LeaseClaim(LeaseRef("boot-1", 1), claim("x0").origin),
    ],
    ids=["key", "worker", "rollout", "attempt", "epoch", "id"],
)
def test_forged_claim_is_cancelled_and_its_result_dropped(forged):
    successor = Successor(2)
    commands = successor.worker("w1", forged)
    commands += successor.apply(LeaseFinished("w1", forged.ref, completed("w1")))
    assert kinds(commands, CancelLease) == [CancelLease("w1", forged.ref)]
    assert kinds(commands, DeliverResult) == []
    assert given_to(successor.wait_out_the_grace()) == [("w1", "x0"), ("w1", "x1")]


def test_claims_of_one_epoch_are_ordered_and_expire_together():
    successor = Successor(2)
    successor.worker("w1", claim("x0", epoch=7), claim("x1", epoch=7), slots=2)
    assert len(successor.dispatcher.live_leases) == 2
    commands = successor.apply(Tick(), after_s=31.0)
    assert {command.ref for command in kinds(commands, CancelLease)} == {
        claim("x0", epoch=7).ref,
        claim("x1", epoch=7).ref,
    }


def test_claim_repeated_by_its_worker_is_adopted_once():
    successor = Successor(1)
    successor.worker("w1", claim("x0"), claim("x0"))
    assert len(successor.dispatcher.live_leases) == 1
    successor.apply(WorkerLost("w1", "killed"))
    assert kinds(successor.worker("w1", claim("x0")), CancelLease) == [CancelLease("w1", claim("x0").ref)]
    successor.dispatcher.state.check_invariants()


@pytest.mark.parametrize(
    "stray",
    [
        claim("x0"),  # it was delivered
        claim("unknown"),
        claim("x1", batch_id="other"),
        claim("x1", epoch=FIRST_EPOCH + 7),  # as if this manager had given it: its book would know
    ],
)
def test_leases_that_cannot_be_adopted_are_cancelled(stray):
    successor = Successor(2, delivered=("x0",))
    assert kinds(successor.worker("w1", stray), CancelLease) == [CancelLease("w1", stray.ref)]


def test_leases_claimed_without_origin_are_cancelled():
    successor = Successor(1)
    old = claim("x0").ref
    successor.apply(WorkerJoined("w1", Resources(1, 1, 1024)))
    commands = successor.apply(WorkerReported("w1", WARM, (old,), resync=True))
    assert kinds(commands, CancelLease) == [CancelLease("w1", old)]
    assert given_to(successor.wait_out_the_grace()) == [("w1", "x0")]


def test_attempts_under_the_former_manager_count():
    successor = Successor(1)
    successor.worker("w1", claim("x0", attempt=3))
    (delivered,) = kinds(successor.apply(WorkerLost("w1", "killed")), DeliverResult)
    assert "attempt 3 of 3" in delivered.result.outcome.message


def test_adopted_lease_expires_like_any_other():
    successor = Successor(1)
    successor.worker("w1", claim("x0"))
    successor.worker("w2")
    commands = successor.apply(Tick(), after_s=31.0)
    assert kinds(commands, CancelLease) == [CancelLease("w1", claim("x0").ref)]
    assert len(given_to(commands)) == 1


def test_fully_delivered_batch_finishes_at_once_and_counts():
    successor = Successor(2, delivered=("x0", "x1"), failures=1)
    assert successor.first == [FinishBatch("r1", "b1")]
    counters = successor.dispatcher.counters("r1")
    assert (counters.delivered, counters.infra_failures) == (2, 1)


def test_cursors_continue_after_those_of_the_former_manager():
    successor = Successor(3, delivered=("x0", "x1"))
    successor.worker("w1", claim("x2"))
    (delivered,) = kinds(successor.apply(LeaseFinished("w1", claim("x2").ref, completed())), DeliverResult)
    assert delivered.result.cursor == 3


def test_batch_cancelled_during_the_wait_is_not_leased():
    successor = Successor(2)
    assert len(kinds(successor.apply(BatchCancelled("r1", "b1")), DeliverResult)) == 2
    successor.worker("w1", slots=4)
    assert given_to(successor.wait_out_the_grace()) == []


@given(
    held=st.lists(st.tuples(st.sampled_from(["w1", "w2", "w3"]), st.integers(0, 5)), max_size=12),
    back=st.permutations(["w1", "w2", "w3"]),
)
def test_every_rollout_gets_one_outcome_whatever_workers_claim(held, back):
    successor = Successor(6)
    claims = {name: [] for name in back}
    for epoch, (name, number) in enumerate(held, 1):
        claims[name].append(claim(f"x{number}", epoch=epoch, worker_id=name))
    delivered, running = [], []

    def settle(commands):
        delivered.extend(command.result.rollout_id for command in kinds(commands, DeliverResult))
        running.extend((command.worker_id, command.ref) for command in kinds(commands, GiveLease))

    for name in back:
        settle(successor.worker(name, *claims[name], slots=2))
        running.extend((name, one.ref) for one in claims[name])
    settle(successor.wait_out_the_grace())
    while running:
        name, ref = running.pop()
        settle(successor.apply(LeaseFinished(name, ref, completed(name))))
    assert sorted(delivered) == [f"x{number}" for number in range(6)]
