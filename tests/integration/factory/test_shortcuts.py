"""Shortcuts, plans that succeed against the instruction, are found, and goals that name what the words name have none."""

from dataclasses import replace

import pytest
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import kitchen_scene

from embomatrix.factory.faithfulness.monitor import watch
from embomatrix.factory.faithfulness.shortcuts import PlanOrigin, find_shortcuts, shortcut_in_words
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle
from embomatrix.world.goal import And, Atom
from embomatrix.world.intent import IntentClause
from embomatrix.world.state import State

MICROWAVED = (
    "move microwave_1; open microwave_1; move apple_1; pick_up apple_1; move microwave_1; "
    "place microwave_1 inside; close microwave_1; toggle_on microwave_1"
)
ON_THE_RUNNING_STOVE = "move apple_1; pick_up apple_1; move stove_1; place stove_1 ontop"
WITH_THE_MICROWAVE = (IntentClause("hot", ("apple_1",), ("microwave_1",)),)


@pytest.fixture(scope="module")
def flat():
    """Return a simulator of the flat with a stove that already runs."""
    scene = kitchen_scene()
    objects = tuple(
        replace(item, states=item.states | {State.TOGGLED_ON}) if item.name == "stove_1" else item
        for item in scene.objects
    )
    simulator = load_simulator(Bundle(replace(scene, objects=objects), {}))
    yield simulator
    simulator.close()


def task_of(simulator, *atom):
    return task_over(simulator.world.scene, Atom(atom[0], atom[1:]))


def test_greedy_search_goes_on_from_a_first_subgoal_that_was_tried_before(flat):
    laid, hot = Atom("ontop", ("bowl_1", "breakfast_table_1")), Atom("hot", ("apple_1",))
    task = task_over(flat.world.scene, And((laid, hot)))
    first = plan_of(
        task, "move bowl_1; pick_up bowl_1; move breakfast_table_1; place breakfast_table_1 ontop"
    )
    found = find_shortcuts(flat, task, WITH_THE_MICROWAVE, (), 1000, [first])
    longer = (*first, *plan_of(task, ON_THE_RUNNING_STOVE))
    assert (PlanOrigin.GREEDY, longer) in [(each.origin, each.plan) for each in found.shortcuts]
    assert found.tried[PlanOrigin.GIVEN] == 1
    assert found.tried.total() <= 1000


def test_equal_swaps_are_executed_once(flat, monkeypatch):
    task = task_of(flat, "inside", "apple_1", "cabinet_1")
    resets = []
    reset = flat.reset
    monkeypatch.setattr(flat, "reset", lambda *given: resets.append(given) or reset(*given))
    plans = 4
    find_shortcuts(flat, task, (), plan_of(task, "move apple_1"), plans)
    # Each plan is stripped of its failing calls and then watched; the greedy search looks at the scene once more.
    assert len(resets) <= 2 * plans + 1


def test_goal_without_its_source_is_reached_by_another_one(flat):
    task = task_of(flat, "hot", "apple_1")
    found = find_shortcuts(flat, task, WITH_THE_MICROWAVE, plan_of(task, MICROWAVED), 100)
    assert found.shortcuts
    sentence = shortcut_in_words(found, task.table)
    assert sentence.startswith("(hot apple_1 microwave_1) is demanded, and this object plan succeeds")
    assert "place stove_1 ontop" in sentence


def test_goal_that_names_its_source_has_no_shortcut(flat):
    task = task_of(flat, "hot", "apple_1", "microwave_1")
    found = find_shortcuts(flat, task, WITH_THE_MICROWAVE, plan_of(task, MICROWAVED), 400)
    assert found.shortcuts == []
    assert found.tried.total() > 300
    assert found.succeeded > 1
    assert set(found.tried) == {*PlanOrigin} - {PlanOrigin.GIVEN}


def test_given_plans_are_tried_first(flat):
    task = task_of(flat, "hot", "apple_1")
    given = [plan_of(task, ON_THE_RUNNING_STOVE)]
    found = find_shortcuts(flat, task, WITH_THE_MICROWAVE, plan_of(task, MICROWAVED), 1, given)
    assert [shortcut.origin for shortcut in found.shortcuts] == [PlanOrigin.GIVEN]


def test_equal_arguments_try_equal_plans(flat):
    task = task_of(flat, "inside", "apple_1", "cabinet_1")
    intent = (IntentClause("inside", ("apple_1",), ("cabinet_1",)),)
    oracle = plan_of(
        task,
        "move cabinet_1; open cabinet_1; move apple_1; pick_up apple_1; move cabinet_1; place cabinet_1 inside",
    )
    one, other = (find_shortcuts(flat, task, intent, oracle, 300) for _ in range(2))
    assert (one.tried, one.succeeded, one.shortcuts) == (other.tried, other.succeeded, other.shortcuts)
    assert one.shortcuts == []


def test_watch_reports_a_relation_other_than_the_stated_one(flat):
    task = task_of(flat, "ontop", "apple_1", "breakfast_table_1")
    intent = (IntentClause("ontop", ("apple_1",), ("bowl_1",)),)
    text = "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside"
    assert watch(flat, task, intent, plan_of(task, text), 0).violated == intent


def test_object_placed_on_something_inside_the_stated_container_meets_the_intent(flat):
    task = task_of(flat, "inside", "apple_1", "fridge_1")
    intent = (IntentClause("inside", ("apple_1",), ("fridge_1",)),)
    text = (
        "move fridge_1; open fridge_1; move bowl_1; pick_up bowl_1; move fridge_1; place fridge_1 inside; "
        "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside"
    )
    found = watch(flat, task, intent, plan_of(task, text), 0)
    assert found.reward.success
    assert not found.violated
