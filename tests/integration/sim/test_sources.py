"""Temperature effects follow from the state, independent of the call that caused it."""

from dataclasses import replace

import pytest
from tests.fakes import furniture as make
from tests.fakes.plans import plan_of, task_over, with_objects
from tests.fakes.scenes import kitchen_scene, placed, upright

from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle
from embomatrix.world.state import State


def scene_with_pan():
    """Return the flat with a pan on the table, and a lukewarm plate."""
    pan = replace(make.bowl(), asset_id="frying_pan-fakeaa", category="frying_pan", synset="frying_pan.n.01")
    return with_objects(
        kitchen_scene(), [(placed("frying_pan_1", pan, "kitchen_0", upright(2.1, 1.4, 0.75, pan)), pan)]
    )


@pytest.fixture(scope="module")
def flat():
    simulator = load_simulator(Bundle(scene_with_pan(), {}))
    yield simulator
    simulator.close()


def after(simulator, text):
    task = task_over(simulator.world.scene)
    trace = simulator.execute(task, plan_of(task, text), 0)
    assert trace.failure is None, trace.steps[-1].message
    return simulator.facts


HEAT_ON_STOVE = "move apple_1; pick_up apple_1; move stove_1; place stove_1 ontop; toggle_on stove_1"


def test_object_in_the_closed_fridge_is_frozen_at_the_start(flat):
    assert after(flat, "turn 0").holds("frozen", ("chicken_leg_1",))
    assert not after(flat, "turn 0").holds("frozen", ("apple_1",))


def test_fridge_freezes_only_when_closed(flat):
    stock = (
        "move fridge_1; open fridge_1; move apple_1; pick_up apple_1; move fridge_1; place fridge_1 inside"
    )
    assert not after(flat, stock).holds("frozen", ("apple_1",))
    assert after(flat, f"{stock}; close fridge_1").holds("frozen", ("apple_1",))


def test_frozen_object_stays_frozen_until_it_is_heated(flat):
    fetch = "move fridge_1; open fridge_1; pick_up chicken_leg_1; move stove_1; place stove_1 ontop"
    assert after(flat, fetch).holds("frozen", ("chicken_leg_1",))
    facts = after(flat, f"{fetch}; toggle_on stove_1")
    assert not facts.holds("frozen", ("chicken_leg_1",))
    assert facts.holds("hot", ("chicken_leg_1",))
    assert facts.holds("cooked", ("chicken_leg_1",))


def test_stove_acts_after_switching_on_and_after_placing_food(flat):
    assert after(flat, HEAT_ON_STOVE).holds("cooked", ("apple_1",))
    other_way = (
        "move stove_1; toggle_on stove_1; move apple_1; pick_up apple_1; move stove_1; place stove_1 ontop"
    )
    assert after(flat, other_way).holds("cooked", ("apple_1",))


def test_food_in_a_pan_on_the_stove_gets_cooked(flat):
    facts = after(
        flat,
        "move frying_pan_1; pick_up frying_pan_1; move stove_1; place stove_1 ontop; move apple_1; pick_up apple_1; "
        "move frying_pan_1; place frying_pan_1 inside; move stove_1; toggle_on stove_1; "
        "cook_object_with_tool apple_1 stove_1",
    )
    assert facts.holds("cooked", ("apple_1",))
    assert facts.holds("hot", ("frying_pan_1",))


def test_food_in_a_bowl_in_the_microwave_gets_hot(flat):
    facts = after(
        flat,
        "move microwave_1; open microwave_1; move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside; "
        "pick_up bowl_1; move microwave_1; place microwave_1 inside; close microwave_1; toggle_on microwave_1",
    )
    assert facts.holds("inside", ("apple_1", "microwave_1"))
    assert facts.holds("hot", ("apple_1",))


def test_uncookable_object_only_gets_hot(flat):
    facts = after(flat, "move mug_1; pick_up mug_1; move stove_1; place stove_1 ontop; toggle_on stove_1")
    assert facts.holds("hot", ("mug_1",))
    assert not facts.holds("cooked", ("mug_1",))


def test_object_beside_a_source_is_unaffected(flat):
    assert not after(flat, HEAT_ON_STOVE).holds("hot", ("bowl_1",))


def test_hot_object_freezes_in_the_fridge_and_stays_cooked(flat):
    facts = after(
        flat,
        f"{HEAT_ON_STOVE}; move fridge_1; open fridge_1; move apple_1; pick_up apple_1; move fridge_1; "
        "place fridge_1 inside; close fridge_1",
    )
    assert facts.holds("frozen", ("apple_1",))
    assert facts.holds("cooked", ("apple_1",))
    assert not facts.holds("hot", ("apple_1",))


def test_reset_undoes_thermal_effects(flat):
    after(flat, HEAT_ON_STOVE)
    assert not after(flat, "turn 0").holds("hot", ("apple_1",))


def test_change_is_reported_once(flat):
    after(flat, HEAT_ON_STOVE)
    assert flat.world.let_sources_act() == ()
    assert flat.world.states["apple_1"] == {State.HOT, State.COOKED}


HEAT_IN_MICROWAVE = (
    "move microwave_1; open microwave_1; move apple_1; pick_up apple_1; move microwave_1; "
    "place microwave_1 inside; close microwave_1; toggle_on microwave_1"
)


@pytest.mark.parametrize(
    ("text", "source", "other"),
    [
        (HEAT_ON_STOVE, "stove_1", "microwave_1"),
        (HEAT_IN_MICROWAVE, "microwave_1", "stove_1"),
    ],
)
def test_state_with_a_source_holds_for_the_source_that_acted(flat, text, source, other):
    facts = after(flat, text)
    assert facts.holds("hot", ("apple_1", source))
    assert not facts.holds("hot", ("apple_1", other))


def test_second_source_of_a_hot_object_counts_too(flat):
    facts = after(
        flat,
        f"{HEAT_ON_STOVE}; move microwave_1; open microwave_1; move apple_1; pick_up apple_1; "
        "move microwave_1; place microwave_1 inside; close microwave_1; toggle_on microwave_1",
    )
    assert facts.holds("hot", ("apple_1", "stove_1"))
    assert facts.holds("hot", ("apple_1", "microwave_1"))
    assert facts.holds("cooked", ("apple_1", "stove_1"))


def test_source_of_an_ended_state_no_longer_counts(flat):
    assert after(flat, "turn 0").holds("frozen", ("chicken_leg_1", "fridge_1"))
    facts = after(
        flat,
        "move fridge_1; open fridge_1; pick_up chicken_leg_1; move stove_1; place stove_1 ontop; toggle_on stove_1",
    )
    assert facts.holds("hot", ("chicken_leg_1", "stove_1"))
    assert not facts.holds("frozen", ("chicken_leg_1", "fridge_1"))


def test_reset_restores_the_sources_of_states(flat):
    after(flat, HEAT_ON_STOVE)
    facts = after(flat, "turn 0")
    assert not facts.holds("hot", ("apple_1", "stove_1"))
    assert facts.holds("frozen", ("chicken_leg_1", "fridge_1"))
