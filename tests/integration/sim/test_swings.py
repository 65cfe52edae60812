"""Predicted swings equal measured ones."""

import pytest
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import upright
from tests.integration.sim.test_panels import drawer_scene

from embomatrix.sim.executor import Simulator
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle

DRAWERS = "bottom_cabinet_1"
PLANS = (
    f"move {DRAWERS}; open {DRAWERS}",
    f"move {DRAWERS}; open {DRAWERS}; close {DRAWERS}; open {DRAWERS}",
    f"move apple_1; pick_up apple_1; move {DRAWERS}; place {DRAWERS} ontop; open {DRAWERS}",
    f"move {DRAWERS}; open {DRAWERS}; pick_up mug_2; move coffee_table_1; place coffee_table_1 ontop; "
    f"move {DRAWERS}; close {DRAWERS}; open {DRAWERS}",
    "move fridge_1; open fridge_1; move microwave_1; open microwave_1",
)


@pytest.fixture(scope="module")
def both():
    """Return one simulator with predicted swings and one without."""
    ahead, then = load_simulator(Bundle(drawer_scene(), {})), load_simulator(Bundle(drawer_scene(), {}))
    for _ in ahead.warm_up():
        pass
    yield ahead, then
    ahead.close()
    then.close()


def in_the_way(simulator: Simulator, y_m: float) -> None:
    """Move the bowl before the drawers."""
    simulator.world.engine.set_pose("bowl_1", upright(4.0, y_m, 0.0, simulator.world.asset("bowl_1")))


@pytest.mark.parametrize("plan", PLANS)
def test_predicted_swings_do_not_change_traces(both, plan) -> None:
    task = task_over(both[0].world.scene)
    first, second = (simulator.execute(task, plan_of(task, plan), 3) for simulator in both)
    assert first.failure is None
    assert first == second


@pytest.mark.parametrize("y_m", [0.6, 0.64, 0.75, 0.9, 1.2, 3.0])
def test_new_obstacle_before_a_drawer_overrides_the_prediction(both, y_m) -> None:
    task = task_over(both[0].world.scene)
    outcomes = []
    for simulator in both:
        simulator.reset(task, 0)
        in_the_way(simulator, y_m)
        outcomes.append((simulator.world.swings.open(DRAWERS), simulator.world.engine.state_bytes()))
    assert outcomes[0] == outcomes[1]


def test_prediction_leaves_the_scene_unchanged(both) -> None:
    ahead, then = both
    task = task_over(ahead.world.scene)
    for simulator in both:
        simulator.reset(task, 0)
    for _ in ahead.world.swings.warm_up():
        assert ahead.world.engine.state_bytes() == then.world.engine.state_bytes()


def test_changed_scene_gets_no_predictions(both) -> None:
    _, then = both
    simulator = load_simulator(Bundle(drawer_scene(), {}))
    try:
        simulator.world.engine.park("mug_2")
        for _ in simulator.warm_up():
            pass
        plan = plan_of(task_over(then.world.scene), PLANS[0])
        first, second = (item.execute(task_over(then.world.scene), plan, 0) for item in (simulator, then))
        assert first.digest == second.digest, "the mug rides out with its drawer"
    finally:
        simulator.close()


def test_predicted_swing_is_not_measured_again(both) -> None:
    ahead, _ = both
    ahead.reset(task_over(ahead.world.scene), 0)
    assert not ahead.world.swings.open(DRAWERS)
    changed = [name for name, _ in ahead.world.engine.journal.entries]
    assert sorted(changed) == sorted(set(changed)), "every stop on the path would be a separate change"
    assert {DRAWERS, "mug_2", "book_1"} == set(changed)
