"""Places next to, under and inside other objects, in both modes and with the oracle."""

import contextlib
from dataclasses import replace

import pytest
from tests.fakes import furniture as make
from tests.fakes.plans import executed, task_over, with_objects, words_of
from tests.fakes.scenes import kitchen_scene, placed, upright

from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.world.bundle import Bundle
from embomatrix.world.goal import And, Atom

SIMULATORS = {"cached": load_simulator, "physical": physical_simulator}


def furnished():
    """The flat with a shoe and a lunch box on the kitchen table, two bags on a bench, a desk, and a rack on a low table."""
    shoe = replace(make.block("shoe", "shoe.n.01", (0.28, 0.11, 0.1), {}), mass_kg=0.4)
    bag = make.tub("bag", "bag.n.06", (0.36, 0.26, 0.22), 0.01, 0.01, mass_kg=0.6, abilities={})
    satchel = make.tub("satchel", "bag.n.06", (0.3, 0.2, 0.22), 0.01, 0.01, mass_kg=0.6, abilities={})
    box = make.tub("lunch_box", "lunch_box.n.01", (0.18, 0.14, 0.1), 0.008, 0.008, mass_kg=0.3, abilities={})
    bench, desk = (
        make.table("bench", "bench.n.01", (1.0, 0.4, 0.45)),
        make.table("desk", "desk.n.01", (1.2, 0.6, 0.75)),
    )
    rack = make.table("rack", "rack.n.01", (0.6, 0.4, 0.35))
    kitchen, living = "kitchen_0", "living_room_0"
    return with_objects(
        kitchen_scene(),
        [
            (placed("shoe_1", shoe, kitchen, upright(1.85, 1.2, 0.75, shoe)), shoe),
            (placed("bag_1", bag, living, upright(5.45, 3.6, 0.45, bag)), bag),
            (placed("satchel_1", satchel, living, upright(5.92, 3.6, 0.45, satchel)), satchel),
            (placed("lunch_box_1", box, kitchen, upright(2.2, 1.35, 0.75, box)), box),
            (placed("bench_1", bench, living, upright(5.6, 3.6, 0.0, bench), fixed=True), bench),
            (placed("desk_1", desk, living, upright(7.6, 3.7, 0.0, desk), fixed=True), desk),
            (placed("rack_1", rack, living, upright(7.2, 2.7, 0.45, rack)), rack),
        ],
    )


@pytest.fixture(scope="module", params=SIMULATORS)
def flat(request):
    with contextlib.closing(SIMULATORS[request.param](Bundle(furnished(), {}))) as simulator:
        yield simulator


@pytest.fixture(scope="module")
def cached():
    with contextlib.closing(load_simulator(Bundle(furnished(), {}))) as simulator:
        yield simulator


@pytest.mark.parametrize(
    ("before", "name", "target", "host"),
    [
        ("", "apple_1", "microwave_1", "countertop_1"),
        ("", "apple_1", "fridge_1", None),
        ("", "mug_1", "apple_2", "coffee_table_1"),
        ("move fridge_1; open fridge_1; ", "apple_1", "chicken_leg_1", "fridge_1"),
        ("", "apple_1", "mug_1", "shelf_1"),
        ("", "shoe_1", "bench_1", None),
    ],
)
def test_object_is_put_next_to_another_on_what_that_one_stands_on(flat, before, name, target, host):
    trace = executed(flat, f"{before}move {name}; pick_up {name}; move {target}; place {target} nextto")
    assert trace.failure is None, trace.steps[-1].message
    assert trace.steps[-1].message == f"put {name} next to {target}"
    assert flat.facts.holds("nextto", (name, target))
    found = flat.world.relations.host_of(name)
    assert (found.name if found is not None else None) == host


@pytest.mark.parametrize(
    ("name", "target"), [("shoe_1", "bench_1"), ("satchel_1", "desk_1"), ("mug_1", "rack_1")]
)
def test_object_is_put_under_furniture_on_the_floor_and_on_a_table(flat, name, target):
    trace = executed(flat, f"move {name}; pick_up {name}; move {target}; place {target} under")
    assert trace.failure is None, trace.steps[-1].message
    assert flat.facts.holds("under", (name, target))


PACK = "move apple_1; pick_up apple_1; move lunch_box_1; place lunch_box_1 inside; pick_up lunch_box_1; "


@pytest.mark.parametrize(
    ("plan", "container"),
    [
        (PACK + "move bag_1; place bag_1 inside", "bag_1"),
        ("move fridge_1; open fridge_1; " + PACK + "move fridge_1; place fridge_1 inside", "fridge_1"),
    ],
)
def test_filled_container_keeps_its_contents_inside_another_container(flat, plan, container):
    trace = executed(flat, plan)
    assert trace.failure is None, trace.steps[-1].message
    for inner, outer in (("apple_1", "lunch_box_1"), ("lunch_box_1", container), ("apple_1", container)):
        assert flat.facts.holds("inside", (inner, outer))


def test_bag_with_a_filled_box_keeps_both_when_it_is_carried_on(flat):
    trace = executed(
        flat,
        PACK + "move bag_1; place bag_1 inside; pick_up bag_1; move bench_1; place bench_1 nextto",
    )
    assert trace.failure is None, trace.steps[-1].message
    assert flat.facts.holds("nextto", ("bag_1", "bench_1"))
    assert flat.facts.holds("inside", ("apple_1", "lunch_box_1"))
    assert flat.facts.holds("inside", ("lunch_box_1", "bag_1"))


@pytest.mark.parametrize(
    ("atoms", "plan"),
    [
        (
            (("nextto", "shoe_1", "bench_1"),),
            "move shoe_1; pick_up shoe_1; move bench_1; place bench_1 nextto",
        ),
        (
            (("under", "mug_1", "rack_1"),),
            "move mug_1; pick_up mug_1; move rack_1; place rack_1 under",
        ),
        (
            (("under", "satchel_1", "desk_1"),),
            "move satchel_1; pick_up satchel_1; move desk_1; place desk_1 under",
        ),
        (
            (
                ("inside", "apple_1", "lunch_box_1"),
                ("inside", "lunch_box_1", "bag_1"),
                ("nextto", "bag_1", "bench_1"),
            ),
            PACK + "move bag_1; place bag_1 inside; pick_up bag_1; move bench_1; place bench_1 nextto",
        ),
    ],
)
def test_oracle_aims_at_the_relation(cached, atoms, plan):
    goal = And(tuple(Atom(predicate, tuple(names)) for predicate, *names in atoms))
    task = task_over(cached.world.scene, goal)
    assert words_of(find_plan(cached, task), task) == plan


def test_nothing_is_put_next_to_an_object_that_hangs_at_a_wall():
    clock = make.block("wall_clock", "wall_clock.n.01", (0.3, 0.05, 0.3), {})
    hung = placed("wall_clock_1", clock, "kitchen_0", upright(2.0, 0.03, 1.2, clock), fixed=True)
    scene = with_objects(kitchen_scene(), [(hung, clock)])
    with contextlib.closing(load_simulator(Bundle(scene, {}))) as simulator:
        trace = executed(
            simulator, "move apple_1; pick_up apple_1; move wall_clock_1; place wall_clock_1 nextto"
        )
    assert trace.failure is FailureReason.NO_SURFACE
    assert trace.steps[-1].message.startswith("nothing can be placed next to wall_clock_1")
