"""Dispatcher driven by hand: a test applies events and reads the resulting commands."""

from tests.fakes.worker import completed

from embomatrix.manager.control.commands import DeliverResult, GiveLease
from embomatrix.manager.control.dispatch.dispatcher import Dispatcher
from embomatrix.manager.control.dispatch.state import DispatchLimits
from embomatrix.manager.control.events import (
    BatchSubmitted,
    LeaseFinished,
    WorkerJoined,
    WorkerReported,
)
from embomatrix.rpc.wire.values import (
    Batch,
    InfraCode,
    InfraFailure,
    Resident,
    ResidentState,
    Resources,
    Rollout,
)

LIMITS = DispatchLimits(
    lease_ttl_s=30, lease_limit_s=100, rollout_deadline_s=600, no_capacity_s=60, lone_load_failure_s=10
)


class Table:
    """Dispatcher with its clock. Keeps its commands by kind."""

    def __init__(self, limits=LIMITS):
        self.dispatcher = Dispatcher(limits, lease_key=b"key")
        self.now_s = 0.0
        self.results = {}

    def apply(self, *events, after_s=0.0):
        self.now_s += after_s
        commands = [c for event in events for c in self.dispatcher.handle(event, now_s=self.now_s)]
        for command in commands:
            if isinstance(command, DeliverResult):
                assert command.result.rollout_id not in self.results, "delivered twice"
                self.results[command.result.rollout_id] = command.result
        return commands

    def worker(self, worker_id="w1", slots=1, warm=("kitchen",)):
        self.apply(WorkerJoined(worker_id, Resources(slots, slots, 1024)))
        return self.report(worker_id, warm=warm, resync=True)

    def report(self, worker_id="w1", warm=(), failed=(), held=(), resync=False, draining=False):
        residents = [Resident(scene, ResidentState.WARM) for scene in warm]
        residents += [Resident(scene, ResidentState.FAILED, error="no mesh") for scene in failed]
        return self.apply(WorkerReported(worker_id, tuple(residents), tuple(held), draining, resync))

    def submit(self, count=1, scene="kitchen", batch_id="b1", group_size=1, run_id="r1"):
        rollouts = tuple(
            Rollout(f"{batch_id}-{i}", f"{batch_id}-g{i // group_size}", scene, "t", (), 0)
            for i in range(count)
        )
        return self.apply(BatchSubmitted(Batch(run_id, batch_id, 1, rollouts)))

    def submit_in_pieces(self, count, piece, group_size=1):
        rollouts = tuple(
            Rollout(f"b1-{i}", f"g{i // group_size}", "kitchen", "t", (), 0) for i in range(count)
        )
        return self.apply(BatchSubmitted(Batch("r1", "b1", 1, rollouts), piece))

    def finish(self, lease, outcome=None):
        return self.apply(LeaseFinished(lease.worker_id, lease.ref, outcome or completed(lease.worker_id)))


def leases(commands):
    """Return the granted leases in order."""
    return [command for command in commands if isinstance(command, GiveLease)]


def crash():
    """Return the outcome of a slot that died."""
    return InfraFailure(InfraCode.SLOT_CRASHED, "signal 11")
