"""Facts answer every predicate of the vocabulary and refuse the others by name."""

from dataclasses import replace

import pytest
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.simulation import load_simulator
from embomatrix.sim.state.facts import FactError
from embomatrix.world.bundle import Bundle
from embomatrix.world.state import Relation, State, SubstanceRelation


def stained_scene():
    scene = kitchen_scene()
    objects = tuple(
        replace(item, states=frozenset({State.STAINED, State.DUSTY})) if item.name == "bowl_1" else item
        for item in scene.objects
    )
    return replace(scene, objects=objects)


@pytest.fixture(scope="module")
def flat():
    simulator = load_simulator(Bundle(stained_scene(), {}))
    task = task_over(simulator.world.scene)
    simulator.execute(task, plan_of(task, "move fridge_1; open fridge_1"), 0)
    yield simulator
    simulator.close()


@pytest.mark.parametrize(
    ("predicate", "args", "expected"),
    [
        ("ontop", ("bowl_1", "breakfast_table_1"), True),
        ("ontop", ("breakfast_table_1", "bowl_1"), False),
        ("inside", ("chicken_leg_1", "fridge_1"), True),
        ("under", ("bowl_1", "breakfast_table_1"), False),
        ("nextto", ("stove_1", "countertop_1"), True),
        ("touching", ("bowl_1", "breakfast_table_1"), True),
        ("inroom", ("mug_1", "living_room_0"), True),
        ("inroom", ("mug_1", "kitchen_0"), False),
        ("open", ("fridge_1",), True),
        ("open", ("microwave_1",), False),
        ("toggled_on", ("stove_1",), False),
        ("frozen", ("chicken_leg_1",), True),
        ("stained", ("bowl_1",), True),
        ("dusty", ("apple_1",), False),
    ],
)
def test_predicate_is_evaluated(flat, predicate, args, expected):
    assert flat.facts.holds(predicate, args) is expected


@pytest.mark.parametrize("predicate", [*Relation])
def test_every_relation_is_known(flat, predicate):
    assert flat.facts.holds(
        predicate.value, ("apple_1", "kitchen_0" if predicate is Relation.INROOM else "bowl_1")
    ) in (
        True,
        False,
    )


@pytest.mark.parametrize("predicate", [*State])
def test_every_state_is_known(flat, predicate):
    assert flat.facts.holds(predicate.value, ("apple_1",)) in (True, False)


@pytest.mark.parametrize(
    ("predicate", "args"),
    [("grasped", ("apple_1", "bowl_1")), ("covered", ("apple_1",)), ("ontop", ("apple_1",)), ("hot", ())],
)
def test_unknown_predicate_error_lists_the_known_ones(flat, predicate, args):
    with pytest.raises(FactError, match="expected one of ontop"):
        flat.facts.holds(predicate, args)


def test_unknown_object_is_named(flat):
    with pytest.raises(FactError, match="no object 'ghost_1'"):
        flat.facts.holds("hot", ("ghost_1",))


@pytest.mark.parametrize("predicate", [*SubstanceRelation])
def test_every_relation_to_a_substance_is_known(flat, predicate):
    assert flat.facts.holds(predicate.value, ("apple_1", "salt.n.02")) is False


def test_dusty_and_stained_equal_coverings_in_both_dialects(flat):
    assert flat.facts.holds("covered", ("bowl_1", "dust.n.01"))
    assert flat.facts.holds("covered", ("bowl_1", "stain.n.01"))
    assert not flat.facts.holds("covered", ("bowl_1", "water.n.06"))


def test_object_in_the_world_is_real_and_not_future(flat):
    assert flat.facts.holds("real", ("apple_1",))
    assert not flat.facts.holds("future", ("apple_1",))
