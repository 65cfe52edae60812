"""Sight of the robot: walls, doors and furniture hide things, whatever bodies the engine has made before."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.household import household_scene
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import kitchen_scene
from tests.integration.sim.test_household import CALLS

from embomatrix.sim.engine import WALL
from embomatrix.sim.sight import rows_in_sight
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle
from embomatrix.world.goal import Atom


@pytest.fixture(scope="module")
def kitchen():
    simulator = load_simulator(Bundle(kitchen_scene(), {}))
    yield simulator
    simulator.close()


def seen_after(simulator, words=""):
    """Names in sight after each call."""
    task = task_over(simulator.world.scene, Atom("inside", ("apple_1", "fridge_1")))
    simulator.reset(task, 0)
    looks = [seen(simulator)]
    for call in plan_of(task, words) if words else ():
        step = simulator.run_step(call)
        assert step.ok, step
        looks.append(seen(simulator))
    return looks


def seen(simulator):
    return {simulator.world.table[row] for row in rows_in_sight(simulator.world)}


def test_closed_door_hides_what_is_behind_it(kitchen):
    start, at_fridge, opened, closed = seen_after(kitchen, "move fridge_1; open fridge_1; close fridge_1")
    assert "fridge_1" in start
    assert "chicken_leg_1" not in start | at_fridge
    assert "chicken_leg_1" in opened
    assert "chicken_leg_1" not in closed


def test_walls_hide_other_rooms_until_one_is_entered(kitchen):
    start, inside = seen_after(kitchen, "go_to_room living_room_0")
    assert {"apple_1", "sink_1", "coffee_table_1"} <= start  # the table stands before the doorway
    assert not {"cabinet_1", "table_lamp_1"} & start
    assert {"cabinet_1", "table_lamp_1", "coffee_table_1"} <= inside
    assert not {"sink_1", "chicken_leg_1"} & inside


def test_held_object_and_its_contents_are_seen(kitchen):
    for look in seen_after(kitchen, "move apple_1; pick_up apple_1; go_to_room living_room_0")[2:]:
        assert "apple_1" in look


def test_ray_meets_the_first_body_and_no_parked_one(kitchen):
    seen_after(kitchen)
    engine, eye = kitchen.world.engine, (2.0, 2.4, 1.35)
    apple = engine.aabb("apple_1").center_m
    through = tuple(end + (end - start) for start, end in zip(eye, apple, strict=True))
    assert engine.first_met(eye, [apple, through]) == ("apple_1", "apple_1")
    engine.park("apple_1")
    assert engine.first_met(eye, [apple]) == ("",)
    assert engine.first_met(eye, [(2.0, -5.0, 1.35)]) == (WALL,)
    assert engine.first_met(eye, []) == ()
    engine.reset()
    assert engine.first_met(eye, [apple]) == ("apple_1",)


@settings(max_examples=25, deadline=None)
@given(st.lists(CALLS, max_size=6).map("; ".join))
def test_sight_depends_on_the_state_alone(shared_household, words):
    worn, fresh = shared_household
    looks = []
    for simulator in (worn, fresh()):
        task = task_over(simulator.world.scene, Atom("inside", ("rag_1", "sink_1")))
        simulator.reset(task, 0)
        for call in plan_of(task, words) if words else ():
            simulator.run_step(call)
            if simulator is worn:
                rows_in_sight(simulator.world)
        looks.append(rows_in_sight(simulator.world))
        if simulator is not worn:
            simulator.close()
    assert looks[0] == looks[1]


@pytest.fixture(scope="module")
def shared_household():
    bundle = Bundle(household_scene(), {})
    worn = load_simulator(bundle)
    yield worn, lambda: load_simulator(bundle)
    worn.close()
