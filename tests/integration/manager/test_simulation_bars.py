"""Time limits of a simulated cluster with injected faults."""

import math
from dataclasses import replace

import pytest

from embomatrix.bench.cluster.simulated import in_flight, loaded_slowly
from embomatrix.manager.simulation.run import ClusterSimulation, simulate
from embomatrix.manager.simulation.scenario import (
    LOCAL,
    Faults,
    MachineKind,
    Scenes,
    SimulationScenario,
    Trainer,
)

AT_ONCE = Trainer(steps=2, groups=60, group_size=16, write_s=0.0, update_s=0.0, start_s=5.0)
"""Trainer that submits its steps at once: the cluster is the bottleneck."""
ROLLOUTS = AT_ONCE.rollouts
BUSY = SimulationScenario(
    workers=10,
    kinds=(replace(LOCAL, slots=4),),
    execute_s=0.5,
    execute_spread=0.2,
    trainers=(AT_ONCE,),
)


FEW = Trainer(steps=5, groups=30, group_size=4, write_s=8.0, update_s=1.0)
"""Trainer that writes slowly: lost rollouts find free slots."""


def spread_out(trainer=FEW, **changes):
    return replace(BUSY, trainers=(trainer,), **changes)


def after(simulation, seconds, action):
    simulation.queue.after(seconds, action)


def test_soak_without_faults_loses_nothing_and_keeps_slots_busy():
    report = simulate(BUSY)
    assert report.delivered == ROLLOUTS
    assert report.infra_failures == report.stats.redispatched == report.stats.stale_results == 0
    assert report.pressed_utilisation >= 0.95


def test_killing_a_worker_every_two_seconds_costs_at_most_a_fifth_of_the_rest():
    sound = simulate(BUSY)
    report = simulate(replace(BUSY, faults=Faults(death_rate=0.05, silent_deaths=0.0, respawn_s=2.0)))
    assert report.delivered == ROLLOUTS
    assert report.counts["deaths"] >= 8
    assert max(report.detected_s) <= 2.0
    assert report.elapsed_s <= sound.elapsed_s / (0.9 * 0.8)


def test_silent_worker_is_detected_in_ten_seconds_and_its_rollouts_move_in_one():
    simulation = ClusterSimulation(spread_out(faults=Faults(respawn_s=60.0)))
    for index, at_s in enumerate((8.0, 14.0, 20.0)):
        after(simulation, at_s, lambda index=index: simulation.workers[index].kill(silent=True))
    report = simulation.run()
    assert report.delivered == report.submitted
    assert report.infra_failures == 0
    assert len(report.detected_s) == 3
    assert max(report.detected_s) <= 10.0 + 0.1 + 1e-6
    assert report.orphaned_s
    assert max(report.orphaned_s) <= 1.0


def test_crashing_or_hanging_slots_cost_no_rollout_and_no_worker():
    faults = Faults(crash=0.05, hang=0.01)
    report = simulate(replace(BUSY, faults=faults, dispatch=replace(BUSY.dispatch, execute_deadline_s=2.0)))
    assert report.delivered == ROLLOUTS
    # Three times in a row is bad luck: 0.06³ of the rollouts.
    assert report.infra_failures <= 5
    assert report.stats.redispatched >= 0.05 * ROLLOUTS
    assert report.counts["workers lost"] == 0


@pytest.mark.parametrize("directions", [{}, {"up": False}, {"down": False}])
def test_short_partition_moves_no_running_rollout(directions):
    simulation = ClusterSimulation(spread_out())
    after(simulation, 10.0, lambda: simulation.workers[0].cut(5.0, **directions))
    report = simulation.run()
    assert report.delivered == report.submitted
    assert report.stats.redispatched == 0
    assert report.counts["workers lost"] == 0


@pytest.mark.parametrize("directions", [{}, {"up": True, "down": False}])
def test_long_partition_moves_rollouts_once_and_fences_late_results(directions):
    few = Trainer(steps=6, groups=4, group_size=4, write_s=8.0, update_s=4.0)
    simulation = ClusterSimulation(spread_out(few, execute_s=6.0))
    # Where the first group goes, so that rollouts run there when the network is gone.
    after(
        simulation, 8.0, lambda: [w.cut(60.0, **directions) for w in simulation.workers if w.slots.executing]
    )
    report = simulation.run()
    assert report.delivered == report.submitted
    assert report.infra_failures == 0
    assert report.counts["workers lost"] == report.counts["partitions"] >= 1
    assert 4 <= report.stats.redispatched <= 8 * report.counts["partitions"]
    assert report.stats.stale_results >= 1
    assert max(report.orphaned_s) <= 1.0


def test_drained_worker_gets_no_leases_and_costs_no_attempt():
    simulation = ClusterSimulation(spread_out())
    drained = simulation.workers[0]
    after(simulation, 10.0, lambda: simulation.manager.drain(drained.machine.worker_id))
    idle = []
    after(simulation, 20.0, lambda: idle.append(not drained.slots.held()))
    report = simulation.run()
    assert idle == [True]
    assert report.stats.redispatched == report.infra_failures == 0


@pytest.mark.parametrize("slow", [0.0, 0.125])
def test_heterogeneous_workers_finish_within_a_quarter_of_the_bound(slow):
    """One of the eight workers may be ten times slower than it reports."""
    kinds = tuple(
        MachineKind(f"{slots} slots", 1.0, slots, 2048, 1.0, 0.0005, 100.0) for slots in (8, 4, 2, 1)
    )
    scenario = replace(
        BUSY,
        workers=8,
        kinds=kinds,
        scenes=Scenes(count=200, load_s=0.2),
        faults=Faults(slow_workers=slow),
    )
    simulation = ClusterSimulation(scenario)
    speed = sum(worker.machine.resources.slots * worker.machine.speed for worker in simulation.workers)
    report = simulation.run()
    # The mean of a log-normal duration is above its median by exp(spread² / 2).
    bound_s = ROLLOUTS * 0.5 * math.exp(0.2**2 / 2) / speed
    assert report.elapsed_s <= 1.25 * bound_s


@pytest.mark.parametrize("lookahead", [2, 4])
def test_two_steps_of_look_ahead_make_starts_warm_and_waste_little(lookahead):
    cold, ahead = simulate(loaded_slowly(0)), simulate(loaded_slowly(lookahead))
    assert cold.hit_rate == 0.0
    assert ahead.hit_rate >= 0.95
    assert ahead.waste <= 0.1
    assert ahead.start_latency_s <= 0.05 * cold.start_latency_s


def test_always_wrong_look_ahead_costs_at_most_five_percent():
    none, wrong = loaded_slowly(0), loaded_slowly(3)
    surprised = replace(wrong, trainers=(replace(wrong.trainers[0], surprises=1.0),))
    honest = replace(none, trainers=(replace(none.trainers[0], surprises=1.0),))
    assert simulate(surprised).elapsed_s <= 1.05 * simulate(honest).elapsed_s


@pytest.mark.parametrize(("rollouts", "workers"), [(512, 32), (4_096, 256)])
def test_many_rollouts_in_flight_start_at_once_and_keep_slots_busy(rollouts, workers):
    report = simulate(in_flight(workers, rollouts))
    assert report.delivered == 2 * rollouts
    assert report.pressed_utilisation >= 0.8
    assert report.first_result_s <= 1.0 + report.scenario.execute_s


def test_two_runs_share_a_cluster_without_starvation():
    small = replace(AT_ONCE, name="small", groups=10, steps=5, start_s=6.0)
    report = simulate(replace(BUSY, trainers=(AT_ONCE, small)))
    assert report.delivered == report.submitted == ROLLOUTS + 5 * 160
