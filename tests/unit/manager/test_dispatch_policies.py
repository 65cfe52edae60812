"""Policies of the Task-Dispatcher: lost members, late rollouts, stalls, pauses, and fair sharing between runs."""

import hypothesis.strategies as st
import pytest
from hypothesis import given
from tests.fakes.worker import completed

from embomatrix.manager.control.commands import CancelLease, DeliverResult, FinishBatch, GiveLease
from embomatrix.manager.control.dispatch.dispatcher import Dispatcher
from embomatrix.manager.control.dispatch.state import DispatchLimits
from embomatrix.manager.control.events import (
    BatchSubmitted,
    DrainChanged,
    LeaseFinished,
    LeasesRenewed,
    PauseChanged,
    RunOpened,
    SuspicionChanged,
    Tick,
    WorkerJoined,
    WorkerReported,
)
from embomatrix.manager.control.schedule.placement import Need, RunShare, in_turns, quotas
from embomatrix.rpc.wire.leases import LeaseProgress
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    GroupPolicy,
    InfraCode,
    InfraFailure,
    Resident,
    ResidentState,
    Resources,
    Rollout,
    RunTerms,
)

LIMITS = DispatchLimits(known_after=4, hedge_share=0.1)
CRASH = InfraFailure(InfraCode.SLOT_CRASHED, "signal 11")


class Bench:
    """Dispatcher with its clock and the leases that its workers hold."""

    def __init__(self, limits=LIMITS):
        self.dispatcher = Dispatcher(limits, lease_key=b"key")
        self.now_s = 0.0
        self.results = {}
        self.held = {}
        self.hedges = []

    def apply(self, event, after_s=0.0):
        self.now_s += after_s
        commands = self.dispatcher.handle(event, now_s=self.now_s)
        for command in commands:
            match command:
                case DeliverResult(result=result):
                    self.results[result.rollout_id] = result.outcome
                case GiveLease():
                    self.held.setdefault(command.rollout.rollout_id, {})[command.worker_id] = command.ref
                    self.hedges += [command] if command.hedge else []
                case CancelLease(worker_id, ref):
                    for leases in self.held.values():
                        if leases.get(worker_id) == ref:
                            del leases[worker_id]
        return commands

    def worker(self, worker_id, slots=1, warm=("kitchen",), render_slots=0):
        self.apply(WorkerJoined(worker_id, Resources(slots, slots, 1024, render_slots=render_slots)))
        self.report(worker_id, warm, resync=True)

    def report(self, worker_id, warm=("kitchen",), **changes):
        residents = tuple(Resident(scene, ResidentState.WARM) for scene in warm)
        return self.apply(WorkerReported(worker_id, residents, **changes))

    def submit(self, *groups, run_id="r1", batch_id="b1", scene="kitchen", render=False):
        """Submit a batch of groups with these sizes; rollouts are named "batch.group.index"."""
        rollouts = tuple(
            Rollout(f"{batch_id}.{group}.{index}", f"{batch_id}.{group}", scene, "t", (), 0, render)
            for group, size in enumerate(groups)
            for index in range(size)
        )
        return self.apply(BatchSubmitted(Batch(run_id, batch_id, 1, rollouts)))

    def finish(self, rollout_id, outcome=None, worker_id=None, after_s=0.0):
        leases = self.held[rollout_id]
        worker_id = worker_id or next(iter(leases))
        ref = leases.pop(worker_id)
        return self.apply(LeaseFinished(worker_id, ref, outcome or completed(worker_id)), after_s)


@pytest.fixture
def bench():
    return Bench()


def policy(bench, group_policy, **terms):
    bench.apply(RunOpened("r1", RunTerms(group_policy, **terms)))


# Group policies


def test_default_policy_cancels_the_rest_of_a_failed_group_only(bench):
    bench.worker("w1", slots=8)
    bench.submit(3, 2)
    bench.finish("b1.0.0")
    for _ in range(3):
        commands = bench.finish("b1.0.1", CRASH)
    assert isinstance(bench.results["b1.0.0"], Completed)
    assert isinstance(bench.results["b1.0.1"], InfraFailure)
    assert bench.results["b1.0.2"] == Cancelled("rollout b1.0.1 was lost: slot_crashed")
    assert [command for command in commands if isinstance(command, CancelLease)]
    assert not {"b1.1.0", "b1.1.1"} & set(bench.results)
    assert bench.dispatcher.counters("r1").groups_failed == 1


def test_partial_policy_keeps_the_other_members(bench):
    policy(bench, GroupPolicy.PARTIAL)
    bench.worker("w1", slots=8)
    bench.submit(2)
    for _ in range(3):
        bench.finish("b1.0.0", CRASH)
    bench.finish("b1.0.1")
    assert isinstance(bench.results["b1.0.1"], Completed)


def test_fail_fast_retries_nothing_and_cancels_the_batch(bench):
    policy(bench, GroupPolicy.FAIL_FAST)
    bench.worker("w1", slots=8)
    bench.submit(2, 2, 2)
    commands = bench.finish("b1.1.0", CRASH)
    assert commands.count(FinishBatch("r1", "b1")) == 1
    assert isinstance(bench.results["b1.1.0"], InfraFailure)
    assert sum(isinstance(outcome, Cancelled) for outcome in bench.results.values()) == 5
    assert bench.dispatcher.counters("r1").groups_failed == 3


def test_slots_freed_by_a_failed_group_are_filled_at_once(bench):
    bench.worker("w1", slots=1)
    bench.submit(2, 2)
    bench.apply(Tick(), after_s=601.0)
    bench.submit(1, batch_id="b2")
    assert "b2.0.0" in bench.held


def test_deadline_of_a_run_overrides_the_default(bench):
    policy(bench, GroupPolicy.PARTIAL, rollout_deadline_s=5.0)
    bench.submit(1)
    bench.apply(Tick(), after_s=5.0)
    assert bench.results["b1.0.0"].code is InfraCode.DEADLINE
    assert "within 5 s" in bench.results["b1.0.0"].message


# Hedging


def known(bench, count=20):
    """Teach the manager a rollout duration of one second; one rollout remains, on w1."""
    bench.worker("w1", slots=count)
    bench.submit(count)
    for index in range(count - 1):
        bench.finish(f"b1.0.{index}", after_s=1.0 if not index else 0.0)


def test_late_rollout_in_a_tail_is_hedged_and_the_first_result_counts(bench):
    known(bench)
    bench.worker("w2")
    bench.apply(Tick(), after_s=0.5)
    assert bench.hedges == []
    bench.apply(Tick(), after_s=2.0)
    (hedge,) = bench.hedges
    assert (hedge.worker_id, hedge.rollout.rollout_id) == ("w2", "b1.0.19")
    first = bench.held["b1.0.19"]["w1"]
    commands = bench.finish("b1.0.19", worker_id="w2")
    assert CancelLease("w1", first) in commands
    assert bench.results["b1.0.19"].worker_id == "w2"
    bench.apply(LeaseFinished("w1", first, completed("w1")))
    assert bench.results["b1.0.19"].worker_id == "w2"
    counters = bench.dispatcher.counters("r1")
    assert (counters.hedged, counters.stale_results, counters.delivered) == (1, 1, 20)
    assert not bench.dispatcher.live_leases


def test_failed_hedge_leaves_the_first_lease_alone(bench):
    known(bench)
    bench.worker("w2")
    bench.apply(Tick(), after_s=3.0)
    bench.finish("b1.0.19", CRASH, worker_id="w2")
    assert bench.dispatcher.counters("r1").redispatched == 0
    bench.finish("b1.0.19", worker_id="w1")
    assert isinstance(bench.results["b1.0.19"], Completed)


def test_rollout_is_hedged_once_and_a_run_within_its_budget():
    bench = Bench(DispatchLimits(known_after=4, hedge_share=0.05))
    bench.worker("w1", slots=40)
    bench.submit(40)
    for index in range(36):
        bench.finish(f"b1.0.{index}", after_s=1.0 if not index else 0.0)
    bench.worker("w2", slots=8)
    for _ in range(20):
        bench.apply(Tick(), after_s=1.0)
    assert len(bench.hedges) == 2


def test_rollout_that_ran_out_of_memory_is_not_hedged(bench):
    bench.worker("w1", slots=20)
    bench.submit(20)
    bench.finish("b1.0.19", InfraFailure(InfraCode.SLOT_OOM, "MemoryError"))
    for index in range(19):
        bench.finish(f"b1.0.{index}", after_s=1.0 if not index else 0.0)
    bench.worker("w2")
    bench.apply(Tick(), after_s=30.0)
    assert bench.hedges == []


def test_scene_of_a_late_rollout_is_loaded_on_another_worker(bench):
    known(bench)
    bench.worker("w2", warm=())
    bench.apply(Tick(), after_s=3.0)
    demand = bench.dispatcher.demand()
    assert demand.pending == {"kitchen": 1}
    assert demand.waited_s["kitchen"] >= 3.0
    bench.report("w2")
    bench.apply(Tick())
    assert [hedge.worker_id for hedge in bench.hedges] == ["w2"]


# Slow workers


def test_last_worker_is_no_longer_treated_as_slow_at_the_next_tick(bench):
    bench.worker("w1", slots=2)
    bench.submit(30)
    for index in range(24):
        bench.finish(f"b1.0.{index}", after_s=0.01)
    for index in range(24, 30):
        bench.finish(f"b1.0.{index}", after_s=2.0)
    bench.submit(20, batch_id="b2")
    bench.apply(Tick(), after_s=0.05)
    assert len([name for name in bench.held if name.startswith("b2") and bench.held[name]]) >= 2


def test_only_worker_gets_a_failed_rollout_again_after_a_pause(bench):
    bench.worker("w1", slots=2)
    bench.worker("w2", warm=())
    bench.submit(1)
    bench.finish("b1.0.0", CRASH)
    assert not bench.held["b1.0.0"]
    bench.apply(SuspicionChanged("w2", suspect=True))
    bench.apply(Tick(), after_s=LIMITS.elsewhere_s + 0.1)
    assert list(bench.held["b1.0.0"]) == ["w1"]


# Progress


def beat(bench, worker_id, rollout_id, steps, after_s):
    ref = bench.held[rollout_id][worker_id]
    return bench.apply(LeasesRenewed(worker_id, (ref,), (LeaseProgress(ref, steps),)), after_s)


def test_stalled_lease_moves_to_another_worker(bench):
    known(bench)
    bench.submit(1, batch_id="b2")
    (worker_id,) = bench.held["b2.0.0"]
    bench.worker("w2")
    for steps in range(8):
        beat(bench, worker_id, "b2.0.0", steps, after_s=3.0)
    beat(bench, worker_id, "b2.0.0", 7, after_s=9.0)
    assert list(bench.held["b2.0.0"]) == [worker_id]
    beat(bench, worker_id, "b2.0.0", 7, after_s=1.0)
    assert list(bench.held["b2.0.0"]) == ["w2"]
    assert bench.dispatcher.counters("r1").redispatched == 1


def test_lease_that_is_renewed_without_any_progress_is_revoked(bench):
    known(bench)
    ref = bench.held["b1.0.19"]["w1"]
    for _ in range(4):
        bench.apply(LeasesRenewed("w1", (ref,)), after_s=5.0)
    assert ref not in bench.held["b1.0.19"].values()


def test_lease_without_progress_is_revoked_in_a_run_without_history(bench):
    bench.worker("w1")
    bench.worker("w2")
    bench.submit(1)
    (ref,) = bench.held["b1.0.0"].values()
    bench.apply(LeasesRenewed("w1", (ref,)), after_s=29.0)
    assert list(bench.held["b1.0.0"]) == ["w1"]
    bench.apply(LeasesRenewed("w1", (ref,)), after_s=2.0)
    assert list(bench.held["b1.0.0"]) == ["w2"]


def test_third_stall_fails_a_rollout(bench):
    known(bench)
    for _ in range(3):
        beat(bench, "w1", "b1.0.19", 3, after_s=1.0)
        beat(bench, "w1", "b1.0.19", 3, after_s=20.0)
    assert bench.results["b1.0.19"].code is InfraCode.STALLED
    assert "did no step for 20 s, after 3" in bench.results["b1.0.19"].message


# Pauses


def test_paused_dispatch_grants_no_leases_until_it_is_resumed(bench):
    bench.worker("w1", slots=2)
    bench.apply(PauseChanged(paused=True))
    bench.submit(2)
    bench.apply(Tick(), after_s=100.0)
    assert bench.held == {}
    assert bench.results == {}
    bench.apply(PauseChanged(paused=False))
    assert set(bench.held) == {"b1.0.0", "b1.0.1"}


def test_paused_worker_finishes_its_leases_and_gets_no_new_ones(bench):
    bench.worker("w1")
    bench.submit(3)
    bench.report("w1", paused="the owner is back")
    bench.finish("b1.0.0")
    assert "b1.0.2" not in bench.held
    bench.report("w1")
    assert "b1.0.2" in bench.held


def test_resumed_worker_gets_work_unless_it_is_leaving(bench):
    bench.worker("w1")
    bench.apply(DrainChanged("w1", drained=True))
    bench.submit(1)
    assert bench.held == {}
    bench.report("w1", draining=True)
    bench.apply(DrainChanged("w1", drained=False))
    assert bench.held == {}
    bench.report("w1", draining=False)
    assert "b1.0.0" in bench.held


# Rendering


def test_rendering_rollouts_are_limited_to_rendering_slots(bench):
    bench.worker("w1", slots=4)
    bench.worker("w2", slots=4, render_slots=1)
    bench.submit(3, render=True)
    assert [list(leases) for leases in bench.held.values()] == [["w2"]]
    bench.submit(2, batch_id="b2")
    assert "b2.0.1" in bench.held
    bench.finish("b1.0.0")
    assert list(bench.held["b1.0.1"]) == ["w2"]


# Runs beside one another


def test_later_run_gets_the_next_free_slot_beside_a_large_batch(bench):
    bench.worker("w1", slots=2)
    bench.submit(200, run_id="large", batch_id="large")
    bench.submit(1, run_id="small", batch_id="small")
    bench.finish("large.0.0", after_s=1.0)
    assert "small.0.0" in bench.held


@pytest.mark.parametrize(("weight", "share"), [(1.0, 0.5), (3.0, 0.25)])
def test_new_run_gets_its_share_before_slot_times_are_known(bench, weight, share):
    bench.worker("w1")
    bench.submit(1, run_id="before", batch_id="before")
    # From here on the worker is given many leases ahead, and each run's are charged as if they took a second.
    bench.finish("before.0.0", after_s=0.001)
    bench.apply(RunOpened("first", RunTerms(weight=weight)))
    bench.submit(800, run_id="first", batch_id="first")
    bench.submit(800, run_id="second", batch_id="second")
    for _ in range(600):
        bench.finish(next(name for name, leases in bench.held.items() if leases), after_s=0.001)
    done = [name.partition(".")[0] for name in bench.results]
    assert done.count("second") / len(done) == pytest.approx(share, abs=0.05)


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 2), st.floats(1.0, 9.0)), max_size=30),
    st.fixed_dictionaries({run: st.sampled_from([0.5, 1.0, 4.0]) for run in "abc"}),
)
def test_needs_keep_their_order_and_runs_their_weights(entries, weights):
    by_rank = sorted(entries, key=lambda entry: entry[1])
    needs = [
        Need(f"scene-{index}", rank, 1, work_s=cost, share=RunShare(run, weights[run]))
        for index, (run, rank, cost) in enumerate(by_rank)
    ]
    ordered = in_turns(needs, lambda need: need.work_s)
    assert sorted(map(id, ordered)) == sorted(map(id, needs))
    assert [need.rank for need in ordered] == sorted(need.rank for need in needs)
    for run in "abc":
        mine = [need for need in needs if need.share.run_id == run]
        assert [need for need in ordered if need.share.run_id == run] == mine
    if {need.rank for need in needs} <= {0}:
        spent = dict.fromkeys("abc", 0.0)
        for index, need in enumerate(ordered):
            spent[need.share.run_id] += need.work_s / need.share.weight
            behind = {later.share.run_id for later in ordered[index + 1 :]} - {need.share.run_id}
            assert all(spent[need.share.run_id] <= spent[run] + 9.0 / weights[run] + 1e-9 for run in behind)


def test_run_with_a_tiny_weight_beside_a_large_one_gets_the_slots_that_are_left():
    large, small = RunShare("large", 1e6), RunShare("small", 1e-300)
    assert quotas({large: 1, small: 5}, 4) == {large: 1.0, small: 3.0}


@given(
    st.dictionaries(
        st.builds(
            RunShare, st.text("abcdef", min_size=1), st.sampled_from([1e-3, 0.5, 3.0, 1e6]), st.integers(0, 1)
        ),
        st.integers(0, 100),
        min_size=1,
    ),
    st.integers(0, 200),
)
def test_quotas_use_all_wanted_slots_and_no_run_exceeds_its_demand(wanted, slots):
    given_slots = quotas(wanted, slots)
    assert all(given_slots[share] <= wanted[share] + 1e-9 for share in wanted)
    assert sum(given_slots.values()) == pytest.approx(min(slots, sum(wanted.values())))
    top = max(share.priority for share in wanted)
    urgent = {share: count for share, count in wanted.items() if share.priority == top}
    assert sum(given_slots[share] for share in urgent) == pytest.approx(min(slots, sum(urgent.values())))
