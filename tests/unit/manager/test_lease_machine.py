"""The whole machine against chaos: crashes, lost messages, late, repeated and reordered results, in any order."""

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from tests.fakes.worker import completed

from embomatrix.manager.assignments import DispatchLimits
from embomatrix.manager.cluster_state import ClusterState
from embomatrix.manager.commands import AcknowledgeLease, CancelLease, DeliverResult, GiveLease, SetDesired
from embomatrix.manager.events import (
    BatchCancelled,
    BatchSubmitted,
    LeaseFinished,
    LeasesRenewed,
    LookaheadAnnounced,
    Tick,
    WorkerDrained,
    WorkerJoined,
    WorkerLost,
    WorkerRecovered,
    WorkerReported,
    WorkerSuspected,
)
from embomatrix.rpc.values import (
    Batch,
    Completed,
    InfraCode,
    InfraFailure,
    LookaheadEntry,
    Resident,
    ResidentState,
    Resources,
    Rollout,
)

WORKERS = ("w1", "w2", "w3")
SCENES = ("kitchen", "bedroom", "hall", "bath")
LIMITS = DispatchLimits(lease_ttl_s=5, lease_limit_s=20, rollout_deadline_s=60, no_capacity_s=15)
workers = st.sampled_from(WORKERS)


class LeaseMachine(RuleBasedStateMachine):
    """The world around the manager: workers that hold what they were told, and a network that loses and repeats."""

    @initialize()
    def begin(self):
        self.cluster = ClusterState(LIMITS, boot_id="boot")
        self.now_s = 0.0
        self.submitted = {}
        self.delivered = {}
        self.live = {}
        self.desired = {}
        self.leases = {}
        self.old = []
        self.epochs = set()
        self.batches = 0

    def tell(self, event, *, lost=False):
        for command in self.cluster.handle(event, now_s=self.now_s):
            match command:
                case DeliverResult(result=result):
                    assert result.rollout_id in self.submitted
                    assert result.rollout_id not in self.delivered, "a second outcome"
                    self.delivered[result.rollout_id] = result
                case GiveLease():
                    assert command.ref.lease_epoch not in self.epochs, "an epoch given twice"
                    assert command.rollout.rollout_id not in self.delivered, "a lease after the outcome"
                    self.epochs.add(command.ref.lease_epoch)
                    if not lost:
                        self.live[command.worker_id][command.ref] = command
                    self.old.append(command)
                case CancelLease(worker_id, ref):
                    self.live.get(worker_id, {}).pop(ref, None)
                case SetDesired(worker_id, scenes):
                    self.desired[worker_id] = scenes
                case AcknowledgeLease():
                    pass

    @rule(worker=workers, slots=st.integers(1, 3), memory_mb=st.sampled_from([64, 150, 1000]))
    def a_worker_joins(self, worker, slots, memory_mb):
        self.live[worker] = {}
        self.desired.pop(worker, None)
        self.tell(WorkerJoined(worker, Resources(slots, slots, memory_mb)))
        self.tell(WorkerReported(worker, (), resync=True))

    @rule(worker=workers, failing=st.sets(st.sampled_from(SCENES), max_size=1), reconnect=st.booleans())
    def a_worker_reports(self, worker, failing, reconnect):
        if worker not in self.live:
            return
        residents = tuple(
            Resident(scene, ResidentState.FAILED if scene in failing else ResidentState.WARM, 0.1, 60.0)
            for scene in self.desired.get(worker, ())
        )
        self.tell(WorkerReported(worker, residents, tuple(self.live[worker]), resync=reconnect))

    @rule(worker=workers)
    def a_worker_is_killed(self, worker):
        self.live.pop(worker, None)
        self.tell(WorkerLost(worker, "killed"))

    @rule(worker=workers)
    def a_stream_breaks_with_leases_on_their_way(self, worker):
        if self.live.get(worker):
            self.live[worker].popitem()

    @rule(worker=workers, event=st.sampled_from([WorkerSuspected, WorkerRecovered, WorkerDrained]))
    def a_worker_changes_its_standing(self, worker, event):
        self.tell(event(worker))

    @rule(count=st.integers(1, 8), scene=st.sampled_from(SCENES))
    def a_batch_comes(self, count, scene):
        self.batches += 1
        rollouts = tuple(Rollout(f"{self.batches}-{i}", "g", scene, "t", (), 0) for i in range(count))
        self.submitted.update({rollout.rollout_id: rollout for rollout in rollouts})
        batch = Batch("r1", f"b{self.batches}", self.batches, rollouts)
        self.tell(BatchSubmitted(batch))
        self.tell(BatchSubmitted(batch))

    @rule(scenes=st.lists(st.sampled_from(SCENES), max_size=4))
    def a_window_comes(self, scenes):
        entries = tuple(LookaheadEntry(self.batches + 1 + i, scene, 4) for i, scene in enumerate(scenes))
        self.tell(LookaheadAnnounced("r1", self.batches + 1, entries))

    @precondition(lambda self: self.batches)
    @rule(data=st.data())
    def a_batch_is_cancelled(self, data):
        self.tell(BatchCancelled("r1", f"b{data.draw(st.integers(1, self.batches))}"))

    @rule(worker=workers, failing=st.sampled_from([None, None, None, *InfraCode]), repeats=st.integers(1, 2))
    def a_lease_ends(self, worker, failing, repeats):
        if not self.live.get(worker):
            return
        ref = next(iter(self.live[worker]))
        del self.live[worker][ref]
        outcome = completed(worker) if failing is None else InfraFailure(failing, "broken")
        for _ in range(repeats):
            self.tell(LeaseFinished(worker, ref, outcome))

    @precondition(lambda self: self.old)
    @rule(data=st.data(), worker=workers)
    def an_old_result_arrives(self, data, worker):
        lease = data.draw(st.sampled_from(self.old))
        for held in self.live.values():
            held.pop(lease.ref, None)
        self.tell(LeaseFinished(worker, lease.ref, completed(worker)))

    @rule(seconds=st.sampled_from([0.1, 1.0, 6.0, 20.0]), renewing=st.booleans())
    def time_passes(self, seconds, renewing):
        self.now_s += seconds
        if renewing:
            for worker, held in self.live.items():
                self.tell(LeasesRenewed(worker, tuple(held)))
        self.tell(Tick())

    @invariant()
    def every_rollout_is_queued_or_leased_or_done(self):
        if not hasattr(self, "cluster"):
            return
        dispatcher = self.cluster.dispatcher
        leased = [lease.record.key.rollout_id for lease in dispatcher.live_leases.values()]
        assert len(leased) == len(set(leased)), "two live leases of one rollout"
        assert not set(leased) & set(self.delivered)
        assert len(leased) + dispatcher.queued == len(self.submitted) - len(self.delivered)
        assert dispatcher.pending_of("r1") == len(self.submitted) - len(self.delivered)

    @invariant()
    def workers_hold_no_more_than_their_credits(self):
        if not hasattr(self, "cluster"):
            return
        workers = self.cluster.dispatcher.workers
        assert all(len(worker.held) <= worker.credits for worker in workers.values())
        held = {lease_id for worker in workers.values() for lease_id in worker.held}
        assert held == set(self.cluster.dispatcher.live_leases)

    @invariant()
    def a_failure_of_the_infrastructure_has_no_reward(self):
        if hasattr(self, "cluster"):
            outcomes = [result.outcome for result in self.delivered.values()]
            assert all(hasattr(o, "reward") == isinstance(o, Completed) for o in outcomes)

    def teardown(self):
        """With a sound worker and enough time, everything ends: nothing is lost."""
        if not hasattr(self, "cluster"):
            return
        for worker in WORKERS:
            self.a_worker_is_killed(worker)
        self.a_worker_joins("w1", 3, 1000)
        for _ in range(100):
            self.a_worker_reports("w1", set(), False)
            while self.live["w1"]:
                self.a_lease_ends("w1", None, 1)
            self.time_passes(1.0, True)
        assert set(self.delivered) == set(self.submitted)
        assert not self.cluster.dispatcher.live_leases


TestLeaseMachine = LeaseMachine.TestCase
TestLeaseMachine.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
