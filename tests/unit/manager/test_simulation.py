"""The cluster simulation: the real state machines among machines that die, hang and lose their network."""

import dataclasses

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

from embomatrix.manager.control.commands import AcknowledgeLease, DeliverResult, FinishBatch, GiveLease
from embomatrix.manager.control.dispatch.state import DispatchLimits
from embomatrix.manager.simulation.invariants import BrokenInvariantError, InvariantChecker
from embomatrix.manager.simulation.network import EventQueue, NetworkPath
from embomatrix.manager.simulation.run import simulate
from embomatrix.manager.simulation.scenario import LOCAL, MIXED, Faults, Scenes, SimulationScenario, Trainer
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.rpc.wire.leases import LeaseOrigin, LeaseRef, WorkerState
from embomatrix.rpc.wire.values import (
    Batch,
    Completed,
    InfraCode,
    InfraFailure,
    Resident,
    ResidentState,
    Rollout,
    RolloutResult,
    Timings,
)

SMALL = SimulationScenario(
    workers=4,
    scenes=Scenes(count=12, load_s=0.3),
    trainers=(Trainer(steps=3, groups=6, group_size=4, write_s=1.0, update_s=0.5, start_s=3.0),),
    dispatch=DispatchLimits(execute_deadline_s=3.0),
    limit_s=1200.0,
)


def test_everything_submitted_is_delivered_without_faults():
    report = simulate(SMALL)
    assert report.delivered == report.submitted == SMALL.rollouts == 72
    assert report.infra_failures == report.stats.redispatched == report.stats.stale_results == 0


def test_equal_scenarios_give_equal_histories():
    scenario = dataclasses.replace(SMALL, faults=Faults(death_rate=0.02, crash=0.02, partition_rate=0.02))
    once, again = simulate(scenario), simulate(scenario)
    assert (once.stats, once.elapsed_s, once.waits_s) == (again.stats, again.elapsed_s, again.waits_s)
    other = simulate(dataclasses.replace(scenario, seed=1))
    assert other.waits_s != once.waits_s


faults = st.builds(
    Faults,
    death_rate=st.sampled_from([0.0, 0.01, 0.1]),
    silent_deaths=st.sampled_from([0.0, 0.5, 1.0]),
    respawn_s=st.sampled_from([0.5, 5.0]),
    partition_rate=st.sampled_from([0.0, 0.01, 0.1]),
    partition_s=st.sampled_from([0.5, 5.0, 60.0]),
    half_open=st.sampled_from([0.0, 0.5, 1.0]),
    crash=st.sampled_from([0.0, 0.05, 0.3]),
    hang=st.sampled_from([0.0, 0.02]),
    load_failure=st.sampled_from([0.0, 0.1]),
    slow_workers=st.sampled_from([0.0, 0.3]),
)
trainers = st.builds(
    Trainer,
    steps=st.integers(1, 3),
    groups=st.integers(1, 6),
    group_size=st.sampled_from([1, 4, 16]),
    distinct=st.sampled_from([0, 1, 3]),
    lookahead=st.integers(0, 4),
    write_s=st.sampled_from([0.0, 1.0]),
    update_s=st.sampled_from([0.0, 1.0]),
    surprises=st.sampled_from([0.0, 0.5]),
)
scenarios = st.builds(
    SimulationScenario,
    seed=st.integers(0, 10_000),
    workers=st.integers(1, 8),
    kinds=st.sampled_from([(LOCAL,), MIXED]),
    scenes=st.builds(Scenes, count=st.integers(1, 12), memory_mb=st.sampled_from([30.0, 400.0])),
    trainers=st.tuples(trainers)
    | st.tuples(trainers, trainers.map(lambda t: dataclasses.replace(t, name="b"))),
    faults=faults,
    dispatch=st.just(SMALL.dispatch),
    limit_s=st.just(7200.0),
)


@given(scenarios)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_each_rollout_has_one_outcome_and_no_failure_a_reward_under_faults(scenario):
    report = simulate(scenario)
    assert report.delivered == report.submitted == scenario.rollouts


REF = LeaseRef("lease", 1)
ORIGIN = LeaseOrigin("run", "batch", "rollout")
ROLLOUT = Rollout("x1", "g", "kitchen", "t", (), 0)
REWARD = RewardBreakdown(0.5, 0.0, 0.0, (), False)


@pytest.fixture
def checker():
    """Return an invariant checker that saw one submitted rollout and two workers with its scene."""
    checker = InvariantChecker(EventQueue())
    checker.submit(Batch("r", "b", 1, (ROLLOUT,)))
    warm = WorkerState((Resident("kitchen", ResidentState.WARM),))
    for worker in ("w1", "w2"):
        checker.report(worker, warm, resync=True)
    return checker


def outcome(result, cursor=1):
    return DeliverResult("r", "b", RolloutResult("x1", "g", cursor, 1, result))


def completed(trace="x1"):
    return Completed(REWARD, (), (), trace, "w1", Timings(), warm=True)


def test_checker_detects_a_second_outcome(checker):
    lost = InfraFailure(InfraCode.WORKER_LOST, "gone")
    checker.watch([outcome(lost)])
    with pytest.raises(BrokenInvariantError, match="x1 was delivered twice"):
        checker.watch([outcome(lost, cursor=2)])


def test_checker_detects_a_reward_without_execution(checker):
    with pytest.raises(BrokenInvariantError, match="x1 has a reward that w1 never computed"):
        checker.watch([outcome(completed())])
    checker.executed("x1", "w1")


def test_checker_detects_the_reward_of_another_rollout(checker):
    checker.executed("x1", "w1")
    with pytest.raises(BrokenInvariantError, match="x1 has the reward of x2"):
        checker.watch([outcome(completed(trace="x2"))])


def test_checker_detects_two_valid_leases_but_allows_a_successor(checker):
    checker.watch([GiveLease("w1", REF, ROLLOUT, 1.0, ORIGIN), AcknowledgeLease("w1", REF)])
    checker.watch([GiveLease("w1", LeaseRef("lease", 2), ROLLOUT, 1.0, ORIGIN)])
    with pytest.raises(BrokenInvariantError, match="x1 has two leases at once"):
        checker.watch([GiveLease("w2", LeaseRef("lease", 3), ROLLOUT, 1.0, ORIGIN)])


def test_checker_detects_a_reused_epoch(checker):
    checker.watch([GiveLease("w1", REF, ROLLOUT, 1.0, ORIGIN), AcknowledgeLease("w1", REF)])
    with pytest.raises(BrokenInvariantError, match="epoch 1 was given twice"):
        checker.watch([GiveLease("w2", REF, ROLLOUT, 1.0, ORIGIN)])


def test_checker_detects_a_lease_to_a_worker_without_the_scene(checker):
    with pytest.raises(BrokenInvariantError, match="w3, which never reported"):
        checker.watch([GiveLease("w3", REF, ROLLOUT, 1.0, ORIGIN)])


def test_checker_detects_a_batch_that_ends_too_early(checker):
    with pytest.raises(BrokenInvariantError, match="batch b ended with 1 rollouts open"):
        checker.watch([FinishBatch("r", "b")])


def test_messages_arrive_in_order_and_after_a_cut():
    queue, heard = EventQueue(), []
    path = NetworkPath(queue, 0.1)
    path.up(lambda: heard.append(("first", queue.now_s)))
    path.cut(5.0, up=True, down=False)
    path.up(lambda: heard.append(("second", queue.now_s)))
    path.down(lambda: heard.append(("down", queue.now_s)))
    queue.run(until=lambda: len(heard) == 3, limit_s=60.0)
    assert heard == [("first", 0.1), ("down", 0.1), ("second", 5.1)]


def test_messages_under_way_on_an_ended_connection_are_lost():
    queue, heard = EventQueue(), []
    path = NetworkPath(queue, 0.1)
    path.up(lambda: heard.append("old"))
    path.hang_up()
    path.up(lambda: heard.append("new"))
    assert not queue.run(until=lambda: len(heard) == 2, limit_s=60.0)
    assert heard == ["new"]
