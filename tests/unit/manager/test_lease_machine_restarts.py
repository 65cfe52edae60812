"""The lease machine with manager restarts: the new manager knows batches and outcomes, the workers their leases."""

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import initialize, invariant, rule
from tests.unit.manager.test_lease_machine import LIMITS, WORKERS, LeaseMachine

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.events import BatchRestored, WorkerJoined, WorkerReported, WorkersExpected
from embomatrix.rpc.wire.leases import LeaseClaim
from embomatrix.rpc.wire.values import Resources


class RestartedMachine(LeaseMachine):
    """Some workers reconnect to the new manager and claim their leases; the others are gone."""

    @initialize()
    def begin(self):
        super().begin()
        self.managers = 1

    @rule(gone=st.sets(st.sampled_from(WORKERS), max_size=1), roster=st.booleans())
    def manager_is_replaced(self, gone, roster):
        slots = {name: worker.slots for name, worker in self.cluster.dispatcher.workers.items()}
        self.managers += 1
        self.hedges = 0
        first_epoch = self.managers << 32
        self.cluster = ClusterState(LIMITS, lease_key=b"key", first_epoch=first_epoch, debug=True)
        for batch in self.batches.values():
            known = [one.rollout_id for one in batch.rollouts if one.rollout_id in self.delivered]
            self.apply(BatchRestored(batch, {name: self.delivered[name].cursor for name in known}))
        if roster:
            self.apply(WorkersExpected(frozenset(self.live)))
        for worker in list(self.live):
            if worker in gone or worker not in slots:
                del self.live[worker]
            else:
                self.worker_returns(worker, slots[worker])

    def worker_returns(self, worker, slots):
        self.desired.pop(worker, None)
        held = dict(self.live[worker])
        claims = tuple(LeaseClaim(ref, command.origin) for ref, command in held.items())
        renders = 0 if worker == "w3" else slots
        self.apply(WorkerJoined(worker, Resources(slots, slots, 1000, render_slots=renders)))
        self.apply(WorkerReported(worker, (), tuple(held), resync=True, claims=claims))

    @invariant()
    def workers_hold_no_more_than_their_credits(self):
        """Adopted leases may exceed the credits: a new manager has not measured the pace of a worker yet."""
        if hasattr(self, "cluster"):
            workers = self.cluster.dispatcher.workers.values()
            held = {lease_id for worker in workers for lease_id in worker.held}
            assert held == set(self.cluster.dispatcher.live_leases)

    @invariant()
    def cursors_of_a_batch_are_unique(self):
        if hasattr(self, "cluster"):
            cursors = [(name.rpartition("-")[0], result.cursor) for name, result in self.delivered.items()]
            assert len(set(cursors)) == len(cursors)


TestRestartedMachine = RestartedMachine.TestCase
TestRestartedMachine.settings = settings(max_examples=40, stateful_step_count=30, deadline=None)
