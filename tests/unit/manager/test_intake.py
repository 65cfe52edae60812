"""Order of worker reports in the state machines."""

from dataclasses import replace

import pytest
from tests.fakes.worker import completed

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.commands import CancelLease, DeliverResult, GiveLease, QuarantineWorker
from embomatrix.manager.control.dispatch.leases import lease_id_of
from embomatrix.manager.control.events import BatchRestored, BatchSubmitted
from embomatrix.manager.runtime.intake import Heartbeat, Intake
from embomatrix.manager.runtime.registry import LivenessLimits, Registry
from embomatrix.rpc.status import SupersededError
from embomatrix.rpc.wire.leases import LeaseClaim, LeaseOrigin, LeaseRef, LeaseResult, WorkerState
from embomatrix.rpc.wire.values import (
    Batch,
    Resident,
    ResidentState,
    Resources,
    Rollout,
)

WARM = (Resident("kitchen", ResidentState.WARM, 0.1, 50.0),)


class Manager:
    """Intake with one worker of one slot, which has the scene and its full number of leases."""

    def __init__(self, rollouts):
        self.intake = Intake(ClusterState(lease_key=b"key"), Registry(LivenessLimits()))
        self.session, _ = self.intake.register("w1", "boot-1", Resources(1, 1, 1000), now_s=0.0)
        self.report(WorkerState(WARM), now_s=0.0, resync=True)
        batch = Batch(
            "r", "b", 1, tuple(Rollout(f"x{i}", "g", "kitchen", "t", (), 0) for i in range(rollouts))
        )
        self.given = gives(self.intake.cluster.handle(BatchSubmitted(batch), now_s=0.1))

    def report(self, state, now_s, resync=False):
        return self.intake.report(self.session, state, (), resync=resync, now_s=now_s)


def gives(commands):
    return [command for command in commands if isinstance(command, GiveLease)]


def test_lease_granted_for_first_state_results_is_not_lost():
    manager = Manager(rollouts=4)
    first, second = (command.ref for command in manager.given)
    state = WorkerState(WARM, (second,), (LeaseResult(first, completed()),))
    commands = manager.report(state, now_s=1.0, resync=True)
    more = gives(commands)
    # The result took a millisecond: more may wait behind the slot from here on.
    assert [lease.rollout.rollout_id for lease in more] == ["x2", "x3"]
    assert not [command for command in commands if isinstance(command, CancelLease)]
    assert set(manager.intake.cluster.dispatcher.live_leases) == {
        second.lease_id,
        *(lease.ref.lease_id for lease in more),
    }


def test_impossible_result_of_a_claimed_lease_is_not_delivered():
    """The manager that gave the lease has ended; its successor adopts the claim and checks the result in one message."""
    cluster = ClusterState(lease_key=b"key", first_epoch=1 << 32)
    intake = Intake(cluster, Registry(LivenessLimits(), first_epoch=1 << 32))
    cluster.handle(
        BatchRestored(Batch("r", "b", 1, (Rollout("x0", "g", "kitchen", "t", (), 0),)), {}), now_s=0.0
    )
    session, _ = intake.register("w1", "boot-1", Resources(1, 1, 1000), now_s=0.1)
    origin = LeaseOrigin("r", "b", "x0", 1)
    ref = LeaseRef(lease_id_of(b"key", origin, "w1", 7), 7)
    honest = completed()
    lie = replace(honest, reward=replace(honest.reward, goal=1e9))
    state = WorkerState(WARM, (), (LeaseResult(ref, lie),), claims=(LeaseClaim(ref, origin),))
    commands = intake.report(session, state, (), resync=True, now_s=0.2)
    assert not [command for command in commands if isinstance(command, DeliverResult)]
    (caught,) = [command for command in commands if isinstance(command, QuarantineWorker)]
    assert "its result of x0 is impossible: its goal reward is 1e+09" in caught.reason


def test_returning_suspect_holds_each_rollout_once():
    manager = Manager(rollouts=1)
    (lease,) = manager.given
    manager.intake.tick(now_s=4.0)
    manager.intake.registry.attach(manager.session, now_s=5.0)
    commands = manager.report(WorkerState(WARM), now_s=5.0, resync=True)
    (again,) = gives(commands)
    assert again.ref != lease.ref
    assert set(manager.intake.cluster.dispatcher.live_leases) == {again.ref.lease_id}


def test_call_of_an_ended_session_is_refused():
    manager = Manager(rollouts=0)
    manager.intake.register("w1", "boot-2", Resources(1, 1, 1000), now_s=1.0)
    with pytest.raises(SupersededError):
        manager.report(WorkerState(), now_s=1.0)
    with pytest.raises(SupersededError):
        manager.intake.heartbeat(manager.session.session_id, manager.session.epoch, Heartbeat(()), now_s=1.0)
