"""Plans executed through a tree of transitions have the results of plain execution."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.household import household_scene
from tests.fakes.plans import plan_of, task_over
from tests.integration.sim.test_household import CALLS

from embomatrix.reward.hierarchy import score
from embomatrix.sim.simulation import load_simulator
from embomatrix.sim.transitions import TransitionTree
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


def test_another_seed_shares_nothing(home, task):
    tree = tree_of(home[0])
    (plan,) = plans_of(task, ["move rag_1; pick_up rag_1"])
    assert [tree.execute(task, plan, seed)[2] for seed in (0, 1, 0)] == [0, 0, 2]


def test_tree_forgets_what_was_not_used_for_longest(home, task):
    tree = tree_of(home[0], most=6)
    old, new = plans_of(task, ["move rag_1; pick_up rag_1", "move plate_2; pick_up plate_2"])
    for plan in (old, new):
        tree.execute(task, plan, 0)
    for seed in range(1, 3):
        tree.execute(task, new, seed)
    assert len(tree) == 6
    assert tree.execute(task, old, 0)[2] == 0
