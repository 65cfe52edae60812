"""A reset restores the state and everything derived from it, bit for bit."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.plans import executed, plan_of, task_over
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle

THINGS = st.sampled_from(["apple_1", "apple_2", "mug_1", "bowl_1", "chicken_leg_1"])
HOSTS = st.sampled_from(["breakfast_table_1", "countertop_1", "shelf_1", "bowl_1", "fridge_1", "microwave_1"])
DOORS = st.sampled_from(["fridge_1", "microwave_1", "cabinet_1"])
SWITCHES = st.sampled_from(["table_lamp_1", "stove_1", "microwave_1"])
RELATIONS = st.sampled_from(["ontop", "inside", "under"])
CALL_SEQUENCES = st.one_of(
    st.builds("move {0}; pick_up {0}".format, THINGS),
    st.builds("move {0}; place {0} {1}".format, HOSTS, RELATIONS),
    st.builds("move {0}; {1} {0}".format, DOORS, st.sampled_from(["open", "close"])),
    st.builds("move {0}; {1} {0}".format, SWITCHES, st.sampled_from(["toggle_on", "toggle_off"])),
    st.builds("heat_object_with_source {0} {1}".format, THINGS, SWITCHES),
    st.builds("cook_object_with_tool {0} {1}".format, THINGS, SWITCHES),
    st.builds("froze_object_with_source {0} {1}".format, THINGS, DOORS),
    st.builds("turn {0}; move_forward {1} {0}".format, st.floats(-3.0, 3.0), st.floats(-1.0, 1.0)),
    st.builds("go_to_room {0}".format, st.sampled_from(["kitchen_0", "living_room_0"])),
)
"""Calls that a person would make together, so that many of them succeed."""
PROBE = (
    "move fridge_1; open fridge_1; move mug_1; pick_up mug_1; move fridge_1; place fridge_1 inside; "
    "close fridge_1; move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"
)


@pytest.fixture(scope="module")
def flat():
    simulator = load_simulator(Bundle(kitchen_scene(), {}))
    yield simulator
    simulator.close()


@pytest.fixture(scope="module")
def probed():
    simulator = load_simulator(Bundle(kitchen_scene(), {}))
    yield executed(simulator, PROBE)
    simulator.close()


@settings(max_examples=40, deadline=None)
@given(st.lists(CALL_SEQUENCES, min_size=1, max_size=8))
def test_reset_undoes_any_sequence_of_skills_to_the_bit(flat, probed, sequences) -> None:
    task = task_over(flat.world.scene)
    flat.reset(task, 0)
    before = flat.world.state_bytes()
    for call in plan_of(task, "; ".join(sequences)):
        flat.run_step(call)  # those that fail change nothing, and the next one is tried
    flat.reset(task, 0)
    assert flat.world.state_bytes() == before
    assert executed(flat, PROBE) == probed
