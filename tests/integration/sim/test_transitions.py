"""Plans and turns executed through a tree of transitions have the results of plain execution."""

import contextlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.household import household_scene
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import kitchen_scene
from tests.integration.sim.test_household import CALLS

from embomatrix.reward.hierarchy import score
from embomatrix.sim.engine import EngineError
from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.simulation import load_simulator
from embomatrix.sim.transitions import TransitionTree
from embomatrix.skills.describe import MAX_FINAL_LINES
from embomatrix.world.bundle import Bundle
from embomatrix.world.goal import Atom

GOAL = Atom("inside", ("rag_1", "sink_1"))
PLANS = st.lists(st.lists(CALLS, max_size=6).map("; ".join), min_size=1, max_size=8)


@pytest.fixture(scope="module")
def home():
    simulators = [load_simulator(Bundle(household_scene(), {})) for _ in range(2)]
    yield simulators
    for simulator in simulators:
        simulator.close()


@pytest.fixture
def task(home):
    return task_over(home[0].world.scene, GOAL)


def plain(simulator, task, plan, seed):
    trace = simulator.execute(task, plan, seed)
    return trace, score(task, trace.touched, simulator.facts)


def tree_of(simulator, most=4_000):
    return TransitionTree(simulator, lambda task: score(task, simulator.touched, simulator.facts), most)


def plans_of(task, texts):
    return [plan_of(task, text) if text else () for text in texts]


@settings(max_examples=60, deadline=None)
@given(PLANS, st.integers(1, 12), st.data())
def test_tree_of_any_size_answers_like_plain_execution(home, texts, most, data):
    task = task_over(home[0].world.scene, GOAL)
    tree = tree_of(home[0], most)
    for plan in plans_of(task, texts):
        cut = data.draw(st.integers(0, len(plan)))
        for part in (plan, plan[:cut], plan):
            seed = data.draw(st.integers(0, 1))
            trace, judged, _ = tree.execute(task, part, seed)
            assert (trace, judged) == plain(home[1], task, part, seed)
            assert len(tree) <= most


def test_equal_prefixes_are_executed_once(home, task):
    tree = tree_of(home[0])
    first, second = plans_of(
        task,
        [
            "move rag_1; pick_up rag_1; move sink_1; place sink_1 inside",
            "move rag_1; pick_up rag_1; move breakfast_table_1; place breakfast_table_1 ontop",
        ],
    )
    counts = []
    for plan in (first, second, first, first[:1]):
        done = []
        counts.append((tree.execute(task, plan, 0, done.append)[2], done))
    assert counts == [(0, [1, 2, 3, 4]), (2, [2, 3, 4]), (4, [4]), (1, [1])]


def test_state_is_unknown_after_an_error_of_the_simulator(home, task, monkeypatch):
    tree = tree_of(home[0])
    first = plan_of(task, "move rag_1; pick_up rag_1")
    tree.execute(task, first, 0)
    run_step, calls = home[0].run_step, []

    def breaks(call):
        calls.append(call)
        step = run_step(call)
        if len(calls) == 1:
            raise EngineError("the engine is gone")
        return step

    monkeypatch.setattr(home[0], "run_step", breaks)
    longer = plan_of(task, "move rag_1; pick_up rag_1; move sink_1; place sink_1 inside")
    with pytest.raises(EngineError):
        tree.execute(task, longer, 0)
    monkeypatch.undo()
    trace, judged, _ = tree.execute(task, longer, 0)
    assert (trace, judged) == plain(home[1], task, longer, 0)


def test_every_object_of_a_long_table_is_described(home, task):
    simulator = home[0]
    simulator.reset(task, 0)
    assert len(task.table) > MAX_FINAL_LINES
    assert [line.partition(":")[0] for line in simulator.survey(task)] == list(task.table)


def test_seeds_share_the_calls_before_the_first_that_draws(home, task):
    tree = tree_of(home[0])
    (plan,) = plans_of(task, ["move rag_1; pick_up rag_1; move sink_1; place sink_1 inside; move plate_2"])
    for seed, shared in ((0, 0), (1, 3), (0, 5), (1, 5), (2, 3)):
        trace, judged, known = tree.execute(task, plan, seed)
        assert known == shared
        assert (trace, judged) == plain(home[1], task, plan, seed)


def test_call_that_draws_is_drawn_with_the_seed_of_its_plan(home, task):
    """The simulator already is in the state that both seeds share when the second one goes on."""
    tree = tree_of(home[0])
    start, put = plans_of(
        task, ["move rag_1; pick_up rag_1; move breakfast_table_1", "place breakfast_table_1 ontop"]
    )
    for seed in range(6):
        tree.execute(task, start, 0)
        assert tree.execute(task, (*start, *put), seed)[:2] == plain(home[1], task, (*start, *put), seed)


def test_tree_forgets_what_was_not_used_for_longest(home, task):
    tree = tree_of(home[0], most=4)
    old, new = plans_of(task, ["move rag_1; pick_up rag_1", "move plate_2; pick_up plate_2"])
    third = plan_of(task, "move mug_1")
    for plan in (old, new, third, new):
        tree.execute(task, plan, 0)
    assert len(tree) == 4
    assert [tree.execute(task, plan, 0)[2] for plan in (new, third, old)] == [2, 1, 0]


def plain_turn(simulator, task, plan, seed, prefix, *, sight=False):
    run = simulator.execute_turn(task, plan, seed, prefix, sight=sight)
    return run, score(task, run.touched, simulator.facts)


def call_alone(simulator, task, plan, seed):
    """Return what a client sees that executes the calls one by one: the steps, and the digest after each."""
    simulator.reset(task, seed)
    return [(simulator.run_step(call), simulator.mark().digest(seed)) for call in plan]


@settings(max_examples=60, deadline=None)
@given(PLANS, st.integers(1, 12), st.data())
def test_turns_through_a_tree_of_any_size_equal_plain_ones(home, texts, most, data):
    task = task_over(home[0].world.scene, GOAL)
    tree = tree_of(home[0], most)
    for plan in plans_of(task, texts):
        seed = data.draw(st.integers(0, 1))
        alone = call_alone(home[1], task, plan, seed)
        prefix = 0
        while prefix < len(plan):
            sight = data.draw(st.booleans())
            looked, judged, _ = tree.execute_turn(task, plan[:prefix], seed, prefix, sight=True)
            assert (looked, judged) == plain_turn(home[1], task, plan[:prefix], seed, prefix, sight=True)
            end = data.draw(st.integers(prefix + 1, len(plan)))
            run, judged, _ = tree.execute_turn(task, plan[:end], seed, prefix, sight=sight)
            assert (run, judged) == plain_turn(home[1], task, plan[:end], seed, prefix, sight=sight)
            assert list(run.steps) == [step for step, _ in alone[: len(run.steps)]]
            assert run.digest == alone[len(run.steps) - 1][1]
            assert all(step.ok for step in run.steps[prefix:-1])
            # A plan that ends at its first failure shares the tree with turns that go on after it.
            trace, judged, _ = tree.execute(task, plan, seed)
            assert (trace, judged) == plain(home[1], task, plan, seed)
            prefix = len(run.steps)


def test_failed_call_shares_the_state_of_the_world_before_it(home, task):
    simulator = home[0]
    simulator.reset(task, 0)
    for call in plan_of(task, "move rag_1; place sink_1 inside; pick_up rag_1; open rag_1; pick_up plate_2"):
        before = simulator.mark()
        if not simulator.run_step(call).ok:
            assert simulator.mark().world == before.world
            shared = simulator.mark_after_failure(before)
            assert shared.world is before.world
            assert shared.digest(0) == simulator.mark().digest(0) != before.digest(0)


def test_turn_after_a_failure_draws_what_it_would_draw_without_it(home, task):
    tree = tree_of(home[0])
    good, failed = plans_of(task, ["move rag_1; pick_up rag_1; move sink_1", "place sink_1 inside"])
    put = plan_of(task, "place sink_1 inside")
    with_failure, _, _ = tree.execute_turn(task, (*failed, *good, *put), 0, 4)
    without, _, _ = tree.execute_turn(task, (*good, *put), 0, 3)
    assert [step.ok for step in with_failure.steps] == [False, True, True, True, True]
    assert with_failure.steps[1:] == without.steps
    assert with_failure.observation == without.observation
    assert with_failure.digest != without.digest


def test_observation_says_what_changed_and_what_the_robot_holds(home, task):
    tree = tree_of(home[0])
    (plan,) = plans_of(task, ["move rag_1; pick_up rag_1"])
    first, _, _ = tree.execute_turn(task, plan[:1], 0, 0)
    second, _, _ = tree.execute_turn(task, plan, 0, 1)
    assert (first.observation.held, first.observation.changes) == ((), ())
    assert second.observation.held == ("rag_1",)
    assert second.observation.changes == ("rag_1: in the robot's hand",)
    assert second.observation.room == home[0].world.robot_room
    assert second.prefix_digest == first.digest


def test_turns_in_physical_mode_equal_plain_ones():
    scene = kitchen_scene()
    task = task_over(scene)
    plan = plan_of(
        task, "move apple_1; pick_up apple_1; pick_up mug_1; move countertop_1; place countertop_1 ontop"
    )
    with (
        contextlib.closing(physical_simulator(Bundle(scene, {}))) as shared,
        contextlib.closing(physical_simulator(Bundle(scene, {}))) as alone,
    ):
        tree = TransitionTree(shared, lambda task: score(task, shared.touched, shared.facts))
        for prefix, end in ((0, 2), (2, 3), (3, 5), (2, 3), (3, 4)):
            run, judged, _ = tree.execute_turn(task, plan[:end], 5, prefix)
            assert (run, judged) == plain_turn(alone, task, plan[:end], 5, prefix)
        assert [step.ok for step in run.steps] == [True, True, False, True]
