"""An object is either inside another one or on top of it, whatever call put it there."""

import itertools

import pytest
from tests.fakes import furniture as make
from tests.fakes.plans import executed, with_objects
from tests.fakes.scenes import kitchen_scene, placed, upright

from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.world.bundle import Bundle
from embomatrix.world.state import Relation


@pytest.fixture(scope="module")
def flat():
    freezer = make.tub("freezer", "deep-freeze.n.02", (0.5, 0.6, 0.6), 0.03, 0.03, mass_kg=40.0, abilities={})
    scene = with_objects(
        kitchen_scene(),
        [(placed("freezer_1", freezer, "kitchen_0", upright(4.4, 3.4, 0.0, freezer), fixed=True), freezer)],
    )
    simulator = load_simulator(Bundle(scene, {}))
    yield simulator
    simulator.close()


@pytest.mark.parametrize("host", ["bowl_1", "freezer_1", "sink_1"])
def test_open_cavity_holds_objects_inside_and_has_no_top(flat, host):
    fetch = f"move apple_1; pick_up apple_1; move {host}; place {host}"
    assert executed(flat, f"{fetch} inside").failure is None
    assert flat.facts.holds("inside", ("apple_1", host))
    assert not flat.facts.holds("ontop", ("apple_1", host))
    assert f"apple_1: inside {host}" in " ".join(executed(flat, f"{fetch} inside").final)
    assert executed(flat, f"{fetch} ontop").failure is FailureReason.NO_SURFACE


def test_shelf_holds_objects_on_top_and_has_no_inside(flat):
    fetch = "move apple_1; pick_up apple_1; move shelf_1; place shelf_1"
    trace = executed(flat, f"{fetch} ontop")
    assert trace.steps[-1].message == "put apple_1 on top of shelf_1"
    assert "apple_1: on shelf_1 in living_room_0" in trace.final
    assert flat.facts.holds("ontop", ("apple_1", "shelf_1"))
    assert not flat.facts.holds("inside", ("apple_1", "shelf_1"))
    assert executed(flat, f"{fetch} inside").failure is FailureReason.NO_CAVITY


def test_no_object_is_both_inside_and_on_top_of_another(flat):
    flat.world.engine.reset()
    names = [item.name for item in flat.world.scene.objects]
    holds = flat.world.relations.holds
    assert not [
        pair
        for pair in itertools.permutations(names, 2)
        if holds(Relation.INSIDE, *pair) and holds(Relation.ONTOP, *pair)
    ]


def test_relations_within_a_carried_bowl_last(flat):
    fill = "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside; pick_up bowl_1"
    trace = executed(flat, fill)
    assert trace.failure is None, trace.steps[-1].message
    assert flat.facts.holds("inside", ("apple_1", "bowl_1"))
    assert not flat.facts.holds("ontop", ("bowl_1", "breakfast_table_1"))
    assert "apple_1: inside bowl_1 in the robot's hand" in trace.final
    executed(flat, f"{fill}; move countertop_1; place countertop_1 ontop")
    assert flat.facts.holds("inside", ("apple_1", "bowl_1"))
    assert flat.facts.holds("ontop", ("bowl_1", "countertop_1"))


def test_object_on_a_shelf_is_not_under_what_stands_above_the_shelf(flat):
    executed(flat, "move apple_1; pick_up apple_1; move shelf_1; place shelf_1 ontop")
    engine = flat.world.engine
    x, y, _ = engine.aabb("mug_1").center_m
    top_m = engine.aabb("shelf_1").high_m[2]
    lamp = engine.pose("table_lamp_1")
    engine.set_pose("table_lamp_1", lamp.__class__((x, y, top_m + 0.2)))
    assert not flat.facts.holds("under", ("mug_1", "table_lamp_1"))
