"""Drawers and doors carry their contents, stop at obstacles, and are reset exactly."""

import dataclasses

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from tests.fakes import furniture as make
from tests.fakes.furniture import box
from tests.fakes.plans import executed, plan_of, task_over, with_objects
from tests.fakes.scenes import NORTH, kitchen_scene, placed, upright

from embomatrix.sim.joints.panels import DoorPanels
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.world.bundle import Bundle
from embomatrix.world.state import Relation

OPENED = "move bottom_cabinet_1; open bottom_cabinet_1"
LOWER_FLOOR_M = 0.25 - 0.22
"""Height of the lower drawer's floor above the room's."""


def drawer_scene():
    """Return the flat with a cabinet of two drawers: a mug in a bowl in the lower one, a book-like block in the upper."""
    cabinet, mug = make.drawer_cabinet(), make.mug()
    block = dataclasses.replace(make.block("book", "book.n.02", (0.2, 0.15, 0.04), {}), mass_kg=0.5)
    x, y = 4.0, 0.26
    return with_objects(
        kitchen_scene(),
        [
            (
                placed(
                    "bottom_cabinet_1", cabinet, "kitchen_0", upright(x, y, 0, cabinet, NORTH), fixed=True
                ),
                cabinet,
            ),
            (placed("mug_2", mug, "kitchen_0", upright(x, y + 0.1, LOWER_FLOOR_M, mug)), mug),
            (placed("book_1", block, "kitchen_0", upright(x, y - 0.05, 0.25 + 0.01, block)), block),
        ],
    )


@pytest.fixture(scope="module")
def flat():
    simulator = load_simulator(Bundle(drawer_scene(), {}))
    yield simulator
    simulator.close()


def test_object_in_a_shut_drawer_is_inside_and_enclosed(flat):
    executed(flat, "go_to_room kitchen_0")
    assert flat.facts.holds("inside", ("mug_2", "bottom_cabinet_1"))
    assert flat.world.closed_around("mug_2") == "bottom_cabinet_1"
    assert flat.world.relations.host_of("book_1").spot == "upper"


def test_robot_steps_aside_from_an_opening_drawer_and_still_reaches_it(flat):
    executed(flat, OPENED)
    world = flat.world
    ground, robot = world.navigator.ground, world.robot
    assert ground.grid.is_free(robot.x_m, robot.y_m)
    assert world.navigator.step_aside("bottom_cabinet_1", robot) == robot
    assert (ground.grid.free < ground.shut.free).any(), "the drawers take floor"
    assert world.reach("bottom_cabinet_1").distance_m <= ROBOT.reach_m
    assert not executed(flat, f"{OPENED}; pick_up mug_2").failure


def test_open_drawer_takes_floor_and_a_shut_one_returns_it(flat):
    executed(flat, "go_to_room kitchen_0")
    navigator, origin = flat.world.navigator, flat.world.robot
    before = navigator.stands("bottom_cabinet_1", origin)
    executed(flat, OPENED)
    beside = navigator.stands("bottom_cabinet_1", origin)
    assert beside
    assert beside != before
    assert all(navigator.ground.grid.is_free(stand.x_m, stand.y_m) for stand in beside)
    executed(flat, f"{OPENED}; close bottom_cabinet_1")
    assert navigator.stands("bottom_cabinet_1", origin) == before


def test_open_drawer_that_blocks_an_aisle_is_named():
    scene, can = drawer_scene(), make.apple()
    aisle = box((4.2, 1.2, 1.2), (1.6, 0.1, 2.4))
    at_its_end = placed("apple_9", can, "kitchen_0", upright(4.75, 0.3, 0.0, can))
    empty = tuple(item for item in scene.objects if item.name != "mug_2")
    scene = dataclasses.replace(scene, objects=empty, walls=(*scene.walls, aisle))
    scene = with_objects(scene, [(at_its_end, can)])
    simulator = load_simulator(Bundle(scene, {}))
    try:
        assert not executed(simulator, "move apple_9").failure
        trace = executed(simulator, f"{OPENED}; move apple_9")
        assert trace.failure is FailureReason.NO_STANDING_POSE
        assert "bottom_cabinet_1" in trace.steps[-1].message
        assert not executed(simulator, f"{OPENED}; close bottom_cabinet_1; move apple_9").failure
    finally:
        simulator.close()


def test_contents_move_with_their_drawer(flat):
    task = task_over(flat.world.scene)
    flat.reset(task, 0)
    before = flat.world.engine.pose("mug_2")
    steps = [flat.run_step(call) for call in plan_of(task, OPENED)]
    assert all(step.ok for step in steps)
    out = flat.world.engine.pose("mug_2")
    assert out.position_m[1] - before.position_m[1] == pytest.approx(0.36)
    assert flat.facts.holds("inside", ("mug_2", "bottom_cabinet_1"))
    assert flat.world.closed_around("mug_2") == ""
    (close,) = plan_of(task, "close bottom_cabinet_1")
    assert flat.run_step(close).ok
    assert flat.world.engine.pose("mug_2").position_m == pytest.approx(before.position_m, abs=1e-9)
    assert flat.world.closed_around("mug_2") == "bottom_cabinet_1"


def test_object_is_picked_up_from_an_open_drawer(flat):
    trace = executed(flat, f"{OPENED}; pick_up mug_2; move coffee_table_1; place coffee_table_1 ontop")
    assert trace.failure is None
    assert not flat.facts.holds("inside", ("mug_2", "bottom_cabinet_1"))


def test_object_is_placed_in_an_open_drawer_that_then_shuts(flat):
    trace = executed(
        flat,
        f"{OPENED}; move apple_1; pick_up apple_1; move bottom_cabinet_1; place bottom_cabinet_1 inside; "
        "close bottom_cabinet_1",
    )
    assert trace.failure is None
    assert flat.facts.holds("inside", ("apple_1", "bottom_cabinet_1"))
    host = flat.world.relations.host_of("apple_1")
    assert host.relation is Relation.INSIDE
    assert host.spot in {"upper", "lower"}


def test_nothing_is_placed_in_a_shut_drawer(flat):
    trace = executed(
        flat, "move apple_1; pick_up apple_1; move bottom_cabinet_1; place bottom_cabinet_1 inside"
    )
    assert trace.failure is FailureReason.CONTAINER_CLOSED


def test_blocked_drawer_opens_up_to_the_obstacle():
    wall = box((4.0, 0.8, 0.25), (1.0, 0.1, 0.5))
    scene = dataclasses.replace(drawer_scene(), walls=(*drawer_scene().walls, wall))
    simulator = load_simulator(Bundle(scene, {}))
    try:
        panels = DoorPanels(simulator.world.engine, simulator.world.relations, "bottom_cabinet_1")
        course = [(share, share) for share in (0.25, 0.5, 0.75, 1.0)]
        reached, other = panels.swing(course)
        assert reached < len(course)
        assert other
        panels.advance(course[reached - 1], course[reached])
        front = simulator.world.engine.aabb("bottom_cabinet_1").high_m[1]
        assert front == pytest.approx(0.75, abs=0.003)
    finally:
        simulator.close()


def test_protruding_object_keeps_a_drawer_from_closing(flat):
    task = task_over(flat.world.scene)
    flat.reset(task, 0)
    for call in plan_of(task, OPENED):
        flat.run_step(call)
    engine = flat.world.engine
    lamp = flat.world.asset("table_lamp_1")
    floor = engine.pose("book_1").position_m[2] + 0.02
    x, y, _ = engine.pose("book_1").position_m
    engine.set_pose("table_lamp_1", upright(x, y, floor, lamp))
    before = engine.state_bytes()
    (close,) = plan_of(task, "close bottom_cabinet_1")
    step = flat.run_step(close)
    assert step.failure is FailureReason.DOOR_BLOCKED
    assert step.message == "table_lamp_1 is in the way of the door of bottom_cabinet_1: clear the way first"
    assert engine.state_bytes() == before


def test_object_before_a_drawer_keeps_it_from_opening(flat):
    task = task_over(flat.world.scene)
    flat.reset(task, 0)
    engine = flat.world.engine
    bowl = flat.world.asset("bowl_1")
    engine.set_pose("bowl_1", upright(4.0, 0.26 + 0.25 + 0.13, 0.0, bowl))
    panels = DoorPanels(engine, flat.world.relations, "bottom_cabinet_1")
    before = engine.state_bytes()
    reached, other = panels.swing([(share, share) for share in (0.25, 0.5, 0.75, 1.0)])
    assert (reached, other) == (0, "bowl_1")
    panels.restore()
    assert engine.state_bytes() == before


def test_objects_on_carried_objects_are_carried_too(flat):
    task = task_over(flat.world.scene)
    flat.reset(task, 0)
    engine = flat.world.engine
    x, y, z = engine.pose("book_1").position_m
    engine.set_pose("apple_1", upright(x, y, z + 0.02, flat.world.asset("apple_1")))
    panels = DoorPanels(engine, flat.world.relations, "bottom_cabinet_1")
    assert set(panels.carried) == {"mug_2", "book_1", "apple_1"}


# After any calls, a reset restores the start bit for bit; a failed call changes nothing.

NAMES = (
    "apple_1",
    "mug_2",
    "book_1",
    "bowl_1",
    "chicken_leg_1",
    "bottom_cabinet_1",
    "fridge_1",
    "microwave_1",
)
SUPPORTS = ("bottom_cabinet_1", "coffee_table_1", "bowl_1", "fridge_1", "countertop_1", "book_1")
CALL = st.one_of(
    st.builds("move {0}; pick_up {0}".format, st.sampled_from(NAMES)),
    st.builds("move {0}; open {0}".format, st.sampled_from(NAMES[-3:])),
    st.builds("move {0}; close {0}".format, st.sampled_from(NAMES[-3:])),
    st.builds(
        "move {0}; place {0} {1}".format,
        st.sampled_from(SUPPORTS),
        st.sampled_from(("ontop", "inside", "under")),
    ),
    st.builds("toggle_on {0}".format, st.sampled_from(("microwave_1", "stove_1"))),
    st.builds("go_to_room {0}".format, st.sampled_from(("kitchen_0", "living_room_0"))),
    st.builds("move_forward {0} {1}".format, st.floats(-1, 1), st.floats(-3, 3)),
)


def state_of(simulator) -> tuple[object, ...]:
    world, engine = simulator.world, simulator.world.engine
    names = world.scene.by_name
    return (
        world.state_bytes(),
        {name: (engine.pose(name), engine.joints(name), engine.is_parked(name)) for name in names},
        {name: world.relations.host_of(name) for name in names},
        {name: engine.penetrates(name) for name in NAMES if not engine.is_parked(name)},
        {name: set(states) for name, states in world.states.items()},
        world.navigator.stands("apple_1", world.robot),
        world.robot,
        world.carried,
    )


def test_reset_undoes_any_sequence_of_calls_to_the_bit(flat):
    task = task_over(flat.world.scene)
    flat.reset(task, 0)
    start = state_of(flat)

    class Household(RuleBasedStateMachine):
        def __init__(self) -> None:
            super().__init__()
            flat.reset(task, 0)

        @rule(text=CALL)
        def call(self, text) -> None:
            for call in plan_of(task, text):
                before = flat.world.state_bytes()
                if not flat.run_step(call).ok:
                    assert flat.world.state_bytes() == before
                    return

        @rule()
        def reset(self) -> None:
            flat.reset(task, 0)
            assert state_of(flat) == start

        @invariant()
        def nothing_floats_in_a_shut_drawer(self) -> None:
            for name in ("mug_2", "book_1"):
                if not flat.world.engine.is_parked(name):
                    assert flat.world.relations.host_of(name) is not None

        def teardown(self) -> None:
            flat.reset(task, 0)
            assert state_of(flat) == start

    run_state_machine_as_test(
        Household, settings=settings(max_examples=12, stateful_step_count=10, deadline=None)
    )
