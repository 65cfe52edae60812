"""A manager that takes time: what it hears waits its turn, and with too many slots they stand still."""

from dataclasses import replace

import pytest

from embomatrix.bench.cluster.saturation import (
    FULL,
    PACES,
    at_work,
    saturated,
    saturation_figures,
    saturation_panels,
)
from embomatrix.bench.cluster.simulated_sweeps import in_flight
from embomatrix.manager.simulation.run import simulate
from embomatrix.manager.simulation.scenario import ManagerPace

SLOTS = 64
EXECUTIONS_PER_S = 60.0
"""What so many slots do at most: executions take a second, and a little more on average."""


def report(pace):
    return simulate(replace(in_flight(SLOTS // 8, 4 * SLOTS), manager=pace))


def test_a_manager_that_is_fast_enough_keeps_its_slots_at_work_and_lags_a_little():
    seen = report(ManagerPace(rollout_s=0.3 / EXECUTIONS_PER_S))
    assert at_work(seen) >= FULL
    assert 0.0 < seen.lag_p99_s < 0.5


def test_a_manager_that_is_half_as_fast_as_its_slots_keeps_half_of_them_at_work_and_loses_nobody():
    seen = report(ManagerPace(rollout_s=2.0 / EXECUTIONS_PER_S))
    assert 0.35 <= at_work(seen) <= 0.65
    assert seen.lag_p99_s > 0.5
    assert (seen.delivered, seen.infra_failures) == (8 * SLOTS, 0)


def test_a_manager_that_takes_no_time_lags_behind_nothing():
    assert report(ManagerPace()).lag_p99_s == 0.0


def test_a_sweep_ends_where_a_manager_is_far_too_slow_and_tells_both_sides_of_the_edge():
    calm, busy = report(ManagerPace()), report(ManagerPace(rollout_s=4.0 / EXECUTIONS_PER_S))
    ran = []

    def run(what, scenario):
        ran.append(what)
        return calm if scenario.workers <= 250 else busy

    found = saturated(run, 10_000)
    assert len(ran) == 3 * len(PACES)
    names = [figure["name"] for figure in saturation_figures(found)]
    assert [name for name in names if "150 µs" in name] == [
        "sim_slots_at_work, 150 µs a rollout, 2,000 slots",
        "sim_manager_lag_p99_s, 150 µs a rollout, 2,000 slots",
        "sim_slots_at_work, 150 µs a rollout, 4,000 slots",
        "sim_manager_lag_p99_s, 150 µs a rollout, 4,000 slots",
    ]
    assert [set(panel.lines) for panel in saturation_panels(found)] == [set(PACES)] * 2


@pytest.mark.parametrize("most", [10, 250])
def test_no_cluster_is_larger_than_was_allowed(most):
    workers = []
    saturated(lambda _, scenario: workers.append(scenario.workers) or report(ManagerPace()), most)
    assert max(workers) == most
