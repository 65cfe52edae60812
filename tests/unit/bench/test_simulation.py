"""Simulated clusters: scenarios stay within bounds, a slow manager saturates, and figures show both sides of the edge."""

import functools
from dataclasses import replace

import pytest

from embomatrix.bench.cluster.simulated import FULL, PACES_US, SimulationBench, in_flight, sweeps
from embomatrix.manager.simulation.run import simulate
from embomatrix.manager.simulation.scenario import ManagerPace

SLOTS = 64
EXECUTIONS_PER_S = 60.0
"""Upper bound for these slots: executions take a second, and a little more on average."""


@functools.cache
def report(pace):
    return simulate(replace(in_flight(SLOTS // 8, 4 * SLOTS), manager=pace))


def test_no_sweep_is_larger_than_allowed():
    for scenarios in sweeps(30).values():
        assert max(scenario.workers for scenario in scenarios.values()) <= 30


def test_fast_manager_keeps_its_slots_busy_and_lags_a_little():
    seen = report(ManagerPace(rollout_s=0.3 / EXECUTIONS_PER_S))
    assert seen.pressed_utilisation >= FULL
    assert 0.0 < seen.lag_p99_s < 0.5


def test_manager_half_as_fast_as_its_slots_keeps_half_of_them_busy_and_loses_nothing():
    seen = report(ManagerPace(rollout_s=2.0 / EXECUTIONS_PER_S))
    assert 0.35 <= seen.pressed_utilisation <= 0.65
    assert seen.lag_p99_s > 0.5
    assert (seen.delivered, seen.infra_failures) == (8 * SLOTS, 0)


def test_manager_that_takes_no_time_has_no_lag():
    assert report(ManagerPace()).lag_p99_s == 0.0


def test_saturation_sweep_stops_at_a_clearly_saturated_manager():
    calm, busy = report(ManagerPace()), report(ManagerPace(rollout_s=4.0 / EXECUTIONS_PER_S))
    ran = []

    def run(scenario):
        ran.append(scenario)
        return calm if scenario.workers <= 250 else busy

    figures = list(SimulationBench(lambda _: None, run).saturation_figures(10_000))
    assert len(ran) == 3 * len(PACES_US)
    assert [figure.name for figure in figures if "150 µs" in figure.name] == [
        f"{name}, 150 µs a rollout, {slots} slots"
        for slots in ("1,000", "2,000", "4,000")
        for name in ("sim_slots_at_work", "sim_manager_lag_p99_s")
    ]


@pytest.mark.parametrize("most", [10, 250])
def test_no_saturated_cluster_is_larger_than_allowed(most):
    workers = []
    answer = report(ManagerPace())
    bench = SimulationBench(lambda _: None, lambda scenario: workers.append(scenario.workers) or answer)
    assert list(bench.saturation_figures(most))
    assert max(workers) == most
