"""A return to a mark is bit-equal to executing its calls again, whatever happened in between."""

import contextlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.household import household_scene
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import kitchen_scene
from tests.integration.sim.test_household import CALLS
from tests.integration.sim.test_reset import CALL_SEQUENCES

from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle

SEEDS = st.integers(0, 3)


@pytest.fixture(scope="module")
def scenes():
    """Two simulators of each scene: one walks, the other executes plainly."""
    made = [
        [load_simulator(Bundle(scene, {})) for _ in range(2)]
        for scene in (kitchen_scene(), household_scene())
    ]
    yield dict(zip(("kitchen", "household"), made, strict=True))
    for pair in made:
        for simulator in pair:
            simulator.close()


def seen(simulator, task):
    """Return everything that an execution shows at this moment."""
    world = simulator.world
    box = {item.name: world.engine.aabb(item.name) for item in world.scene.objects}
    return (
        simulator.mark().hash.hexdigest(),
        world.state_bytes(),
        simulator.touched,
        simulator.survey(task),
        world.robot,
        world.carried,
        world.navigator.ground.floor,
        world.navigator.ground.open_joints,
        box,
    )


def walk(simulators, task, seed, moves):
    """Execute calls and return to marks as the moves say; compare each state with a plain execution."""
    walker, plain = simulators
    walker.reset(task, seed)
    marks, prefixes = [walker.mark()], [()]
    for back, calls in moves:
        number = back % len(marks)
        walker.return_to(marks[number], seed)
        prefix = prefixes[number]
        plain.reset(task, seed)
        for call in prefix:
            plain.run_step(call)
        assert seen(walker, task) == seen(plain, task)
        for call in calls:
            assert walker.run_step(call) == plain.run_step(call)
            prefix = (*prefix, call)
            marks.append(walker.mark())
            prefixes.append(prefix)
        assert seen(walker, task) == seen(plain, task)


def moves_of(calls, most_back, most_calls, most_moves):
    """Return a strategy of moves: how far to go back, and the calls that follow."""
    return st.lists(
        st.tuples(st.integers(0, most_back), st.lists(calls, min_size=1, max_size=most_calls)),
        max_size=most_moves,
    )


def walk_in(simulators, seed, moves):
    task = task_over(simulators[0].world.scene)
    walk(simulators, task, seed, [(back, plan_of(task, "; ".join(calls))) for back, calls in moves])


@settings(max_examples=40, deadline=None)
@given(SEEDS, moves_of(CALL_SEQUENCES, 40, 3, 6))
def test_walk_in_the_kitchen_equals_plain_execution(scenes, seed, moves):
    walk_in(scenes["kitchen"], seed, moves)


@settings(max_examples=40, deadline=None)
@given(SEEDS, moves_of(CALLS, 40, 5, 6))
def test_walk_with_slicing_and_cleaning_equals_plain_execution(scenes, seed, moves):
    walk_in(scenes["household"], seed, moves)


@pytest.mark.slow
@settings(max_examples=5_000, deadline=None)
@given(SEEDS, moves_of(CALL_SEQUENCES, 60, 3, 9))
def test_five_thousand_walks_in_the_kitchen_equal_plain_execution(scenes, seed, moves):
    walk_in(scenes["kitchen"], seed, moves)


@pytest.mark.slow
@settings(max_examples=5_000, deadline=None)
@given(SEEDS, moves_of(CALLS, 60, 5, 9))
def test_five_thousand_walks_with_slicing_equal_plain_execution(scenes, seed, moves):
    walk_in(scenes["household"], seed, moves)


def test_running_water_that_was_undone_acts_again(scenes):
    simulator = scenes["household"][0]
    task = task_over(simulator.world.scene)
    simulator.reset(task, 0)
    *start, on = plan_of(
        task, "move rag_1; pick_up rag_1; move sink_1; place sink_1 inside; toggle_on sink_1"
    )
    assert all(simulator.run_step(call).ok for call in start)
    mark = simulator.mark()
    first = simulator.run_step(on)
    simulator.return_to(mark, 0)
    assert simulator.run_step(on) == first
    assert "soaked" in first.message


@pytest.mark.parametrize("seed", [0, 5])
def test_return_in_physical_mode_equals_executing_the_calls_again(seed):
    scene = kitchen_scene()
    task = task_over(scene)
    *start, last = plan_of(
        task, "move apple_1; pick_up apple_1; pick_up mug_1; move countertop_1; place countertop_1 ontop"
    )
    with contextlib.closing(physical_simulator(Bundle(scene, {}))) as simulator:
        simulator.reset(task, seed)
        assert [simulator.run_step(call).ok for call in start] == [True, True, False, True]
        mark = simulator.mark()
        first = (simulator.run_step(last), seen(simulator, task))
        simulator.return_to(mark, seed)
        simulator.run_step(plan_of(task, "move breakfast_table_1")[0])
        simulator.return_to(mark, seed)
        assert (simulator.run_step(last), seen(simulator, task)) == first
