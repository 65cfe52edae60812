"""A19: property test of the dispatcher and scheduler under crashes, lost messages, and late or repeated results."""

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from tests.fakes.worker import completed

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.commands import (
    AcknowledgeLease,
    CancelLease,
    DeliverResult,
    GiveLease,
    SetDesired,
)
from embomatrix.manager.control.dispatch.state import DispatchLimits
from embomatrix.manager.control.events import (
    BatchCancelled,
    BatchContinued,
    BatchSubmitted,
    DrainChanged,
    LeaseFinished,
    LeasesRenewed,
    LookaheadAnnounced,
    PauseChanged,
    RunOpened,
    SuspicionChanged,
    Tick,
    WorkerJoined,
    WorkerLost,
    WorkerReported,
)
from embomatrix.rpc.wire.leases import LeaseProgress
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    GroupPolicy,
    InfraCode,
    InfraFailure,
    LookaheadEntry,
    Resident,
    ResidentState,
    Resources,
    Rollout,
    RunTerms,
)

WORKERS = ("w1", "w2", "w3")
SCENES = ("kitchen", "bedroom", "hall", "bath")
LIMITS = DispatchLimits(
    lease_ttl_s=5,
    lease_limit_s=20,
    rollout_deadline_s=60,
    no_capacity_s=15,
    elsewhere_s=2.0,
    hedge_share=0.5,
    known_after=2,
    stall_after_s=3.0,
    execute_deadline_s=4.0,
)
RUNS = ("r1", "r2", "r3")
TERMS = st.builds(
    RunTerms,
    st.sampled_from(GroupPolicy),
    st.sampled_from([0.5, 1.0, 4.0]),
    st.integers(0, 1),
    st.sampled_from([0.0, 30.0]),
    st.booleans(),
)
STANDINGS = (
    (SuspicionChanged, True),
    (SuspicionChanged, False),
    (SuspicionChanged, False),
    (DrainChanged, True),
    (DrainChanged, False),
    (DrainChanged, False),
)
"""Kinds of events with their flag; recoveries are twice as frequent."""
workers = st.sampled_from(WORKERS)


class LeaseMachine(RuleBasedStateMachine):
    """Workers and a network around the manager. The state's own invariants are checked after every event."""

    @initialize()
    def begin(self):
        self.cluster = ClusterState(LIMITS, lease_key=b"key", debug=True)
        self.now_s = 0.0
        self.submitted = {}
        self.delivered = {}
        self.live = {}
        self.desired = {}
        self.leases = {}
        self.old = []
        self.epochs = set()
        self.batches = {}
        self.steps = {}
        self.hedges = 0
        for worker in WORKERS:
            self.worker_joins(worker, 2, 1000)

    def apply(self, event, *, lost=False):
        self.now_s += 0.01
        for command in self.cluster.handle(event, now_s=self.now_s):
            assert command.cause is not None, command
            match command:
                case DeliverResult(result=result):
                    assert result.rollout_id in self.submitted
                    assert result.rollout_id not in self.delivered, "a second outcome"
                    assert result.also == self.submitted[result.rollout_id].also
                    self.delivered[result.rollout_id] = result
                case GiveLease():
                    assert command.ref.lease_epoch not in self.epochs, "an epoch given twice"
                    assert command.rollout.rollout_id not in self.delivered, "a lease after the outcome"
                    assert not (command.rollout.render and command.worker_id == "w3"), "w3 renders nothing"
                    self.epochs.add(command.ref.lease_epoch)
                    self.hedges += command.hedge
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
    def worker_joins(self, worker, slots, memory_mb):
        self.live[worker] = {}
        self.desired.pop(worker, None)
        renders = 0 if worker == "w3" else slots
        self.apply(WorkerJoined(worker, Resources(slots, slots, memory_mb, render_slots=renders)))
        self.apply(WorkerReported(worker, (), resync=True))

    @rule(
        worker=workers,
        failing=st.sets(st.sampled_from(SCENES), max_size=1),
        reconnect=st.booleans(),
        paused=st.sampled_from([*[""] * 7, "the owner is back"]),
    )
    def worker_reports(self, worker, failing, reconnect, paused=""):
        if worker not in self.live:
            return
        residents = tuple(
            Resident(scene, ResidentState.FAILED if scene in failing else ResidentState.WARM, 0.1, 60.0)
            for scene in self.desired.get(worker, ())
        )
        self.apply(
            WorkerReported(worker, residents, tuple(self.live[worker]), resync=reconnect, paused=paused)
        )

    @rule(worker=workers)
    def worker_is_killed(self, worker):
        self.live.pop(worker, None)
        self.apply(WorkerLost(worker, "killed"))

    @rule(worker=workers)
    def stream_breaks_with_leases_under_way(self, worker):
        if self.live.get(worker):
            self.live[worker].popitem()

    @rule(
        worker=workers,
        standing=st.sampled_from(STANDINGS),
    )
    def standing_of_a_worker_changes(self, worker, standing):
        event, flag = standing
        self.apply(event(worker, flag))

    @rule(paused=st.sampled_from([True, False, False, False]))
    def operator_pauses_or_resumes(self, paused):
        self.apply(PauseChanged(paused))

    @rule(run=st.sampled_from(RUNS), terms=TERMS)
    def run_is_opened(self, run, terms):
        self.apply(RunOpened(run, terms))

    @rule(
        run=st.sampled_from(RUNS),
        count=st.integers(1, 8),
        size=st.integers(1, 8),
        scene=st.sampled_from(SCENES),
        render=st.sampled_from([False, False, True]),
        piece=st.sampled_from([None, None, 1, 3]),
        equal=st.sampled_from([0, 0, 1, 3]),
    )
    def batch_is_submitted(self, run, count, size, scene, render, piece, equal):
        name = f"b{len(self.batches)}"
        rollouts = tuple(
            Rollout(
                f"{name}-{i}",
                f"{name}.{i // size}",
                scene,
                "t",
                (),
                0,
                render,
                tuple(f"{name}-{i}-{number}" for number in range(equal)),
            )
            for i in range(count)
        )
        self.submitted.update({rollout.rollout_id: rollout for rollout in rollouts})
        self.batches[name] = batch = Batch(run, name, len(self.batches) + 1, rollouts)
        self.apply(BatchSubmitted(batch, piece))
        self.apply(BatchSubmitted(batch, piece))

    @precondition(lambda self: self.batches)
    @rule(data=st.data(), piece=st.integers(1, 4))
    def batch_is_continued(self, data, piece):
        batch = data.draw(st.sampled_from(list(self.batches.values())))
        self.apply(BatchContinued(batch.run_id, batch.batch_id, piece))

    @rule(scenes=st.lists(st.sampled_from(SCENES), max_size=4))
    def look_ahead_is_announced(self, scenes):
        entries = tuple(LookaheadEntry(len(self.batches) + 1 + i, scene, 4) for i, scene in enumerate(scenes))
        self.apply(LookaheadAnnounced("r1", len(self.batches) + 1, entries))

    @precondition(lambda self: len(self.batches) % 4 == 3)
    @rule(data=st.data())
    def batch_is_cancelled(self, data):
        batch = data.draw(st.sampled_from(list(self.batches.values())))
        self.apply(BatchCancelled(batch.run_id, batch.batch_id))

    @rule(rounds=st.integers(1, 6))
    def cluster_works(self, rounds):
        """Let workers make progress: random events alone rarely complete a rollout."""
        for _ in range(rounds):
            for worker in list(self.live):
                self.worker_reports(worker, set(), False)
            for worker in list(self.live)[:-1]:
                self.lease_results(worker, None, 1)
            self.time_passes(0.5, True, 1)

    @rule(worker=workers, failing=st.sampled_from([None, None, None, *InfraCode]), repeats=st.integers(1, 2))
    def lease_results(self, worker, failing, repeats):
        if not self.live.get(worker):
            return
        ref = next(iter(self.live[worker]))
        del self.live[worker][ref]
        outcome = completed(worker) if failing is None else InfraFailure(failing, "broken")
        for _ in range(repeats):
            self.apply(LeaseFinished(worker, ref, outcome))

    @precondition(lambda self: self.old)
    @rule(data=st.data(), worker=workers)
    def stale_result_arrives(self, data, worker):
        lease = data.draw(st.sampled_from(self.old))
        for held in self.live.values():
            held.pop(lease.ref, None)
        self.apply(LeaseFinished(worker, lease.ref, completed(worker)))

    @rule(
        seconds=st.sampled_from([0.1, 1.0, 6.0, 20.0]),
        renewing=st.booleans(),
        moving=st.sampled_from([0, 1, 1]),
    )
    def time_passes(self, seconds, renewing, moving):
        self.now_s += seconds
        if renewing:
            for worker, held in list(self.live.items()):
                for ref in held:
                    self.steps[ref] = self.steps.get(ref, -1) + moving
                progress = tuple(LeaseProgress(ref, self.steps[ref]) for ref in held if self.steps[ref] >= 0)
                self.apply(LeasesRenewed(worker, tuple(held), progress))
        self.apply(Tick())
        self.no_worker_idles_while_an_acceptable_rollout_waits()

    def no_worker_idles_while_an_acceptable_rollout_waits(self):
        """After a tick, no free slot is left while a rollout waits that its worker may take."""
        state = self.cluster.dispatcher.state
        for record in () if state.paused else state.queues:
            for worker in state.pool.workers.values():
                fits = record.scene in worker.warm and worker.takes(record, self.now_s)
                assert not (fits and worker.free_slots > 0), (record.key, worker)

    @invariant()
    def every_rollout_is_queued_or_leased_or_done(self):
        if not hasattr(self, "cluster"):
            return
        dispatcher = self.cluster.dispatcher
        leases = {}
        for lease in dispatcher.live_leases.values():
            leases.setdefault(lease.record.key.rollout_id, []).append(lease)
        assert not set(leases) & set(self.delivered)
        for held in leases.values():
            assert len({lease.worker_id for lease in held}) == len(held) <= 2
            assert len(held) == 1 or held[0].record.hedged
        leased = sum(held[0].record.count for held in leases.values())
        left = sum(one.count for one in self.submitted.values())
        left -= sum(result.count for result in self.delivered.values())
        assert leased + dispatcher.queued == left
        assert sum(map(dispatcher.pending_of, RUNS)) == left

    @invariant()
    def hedges_keep_to_their_budget(self):
        if hasattr(self, "cluster"):
            counted = sum(self.cluster.dispatcher.counters(run).hedged for run in RUNS)
            assert (
                counted
                == self.hedges
                <= LIMITS.hedge_share * sum(one.count for one in self.submitted.values())
            )

    @invariant()
    def cancellations_have_a_reason(self):
        if hasattr(self, "cluster"):
            outcomes = [result.outcome for result in self.delivered.values()]
            assert all(outcome.reason for outcome in outcomes if isinstance(outcome, Cancelled))

    @invariant()
    def workers_hold_no_more_than_their_credits(self):
        if not hasattr(self, "cluster"):
            return
        workers = self.cluster.dispatcher.workers
        assert all(len(worker.held) <= worker.credits for worker in workers.values())
        held = {lease_id for worker in workers.values() for lease_id in worker.held}
        assert held == set(self.cluster.dispatcher.live_leases)

    @invariant()
    def infrastructure_failures_have_no_reward(self):
        if hasattr(self, "cluster"):
            outcomes = [result.outcome for result in self.delivered.values()]
            assert all(hasattr(o, "reward") == isinstance(o, Completed) for o in outcomes)

    def teardown(self):
        """Check that every rollout gets its outcome with one healthy worker and enough time."""
        if not hasattr(self, "cluster"):
            return
        self.apply(PauseChanged(paused=False))
        for worker in WORKERS:
            self.worker_is_killed(worker)
        self.worker_joins("w1", 3, 1000)
        for _ in range(100):
            self.worker_reports("w1", set(), False)
            while self.live["w1"]:
                self.lease_results("w1", None, 1)
            self.time_passes(1.0, True, 1)
        assert set(self.delivered) == set(self.submitted)
        assert not self.cluster.dispatcher.live_leases


TestLeaseMachine = LeaseMachine.TestCase
TestLeaseMachine.settings = settings(max_examples=100, stateful_step_count=40, deadline=None)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_lease_machine_holds_for_a_hundred_thousand_steps():
    run_state_machine_as_test(
        LeaseMachine,
        settings=settings(
            max_examples=1_000,
            derandomize=False,
            stateful_step_count=100,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )
