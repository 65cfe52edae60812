"""Calls that scripts write for demands, which misread sentences may make absurd."""

from tests.fakes.script_examples import ROWS, in_words, situation

from embomatrix.scripts.calls import Habits, ScriptDemand, plan_for

ROW = {row.name: row for row in ROWS}
HABITS = Habits({}, {}, frozenset())


def carry(thing: str, place: str) -> ScriptDemand:
    return ScriptDemand("ontop", True, (ROW[thing],), (ROW[place],))


def test_nothing_is_put_on_what_it_bears_itself() -> None:
    plan = plan_for([carry("bowl_1", "bowl_2"), carry("bowl_2", "bowl_1")], situation(""), HABITS)
    assert in_words(plan).count("pick_up") == 1
    assert "pick_up bowl_2" not in in_words(plan)
    assert plan_for([carry("bowl_1", "bowl_1")], situation(""), HABITS) == ()


def test_what_bears_a_thing_is_known_through_all_levels() -> None:
    stacked = [carry("bowl_1", "bowl_2"), carry("pear_1", "bowl_1"), carry("bowl_2", "pear_1")]
    assert in_words(plan_for(stacked, situation(""), HABITS)).count("pick_up") == 2


def test_a_fixed_object_misread_as_a_tool_is_put_back_elsewhere() -> None:
    dusted = ScriptDemand("dusty", False, (ROW["bowl_2"],), (ROW["countertop_1"],))
    borne = ScriptDemand("dusty", False, (ROW["apple_1"],), (ROW["bowl_1"],))
    words = in_words(plan_for([dusted, borne], situation(""), HABITS))
    assert "pick_up countertop_1" in words
    assert "place fridge_1 ontop" in words
