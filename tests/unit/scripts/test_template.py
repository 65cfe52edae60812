"""Template script: phrases, names and machines that it learns, and the calls that it writes."""

import pytest
from tests.fakes.script_examples import ROWS, example, in_state, in_words, situation, training

from embomatrix.scripts.template import TemplateScript
from embomatrix.world.intent import IntentClause


@pytest.fixture(scope="module")
def script():
    return TemplateScript.fit(training())


def demanded(script, instruction, rows=ROWS):
    """Demands of an instruction as text: ``inside apple_1 fridge_1``."""
    return [
        " ".join(
            [
                "" if demand.holds else "not",
                demand.predicate,
                demand.things[0].name,
                *(row.name for row in demand.places[:1]),
            ]
        ).strip()
        for demand in script.demands(situation(instruction, rows))
    ]


@pytest.mark.parametrize(
    ("instruction", "demands"),
    [
        ("Put the pear in the fridge.", ["inside pear_1 fridge_1"]),
        ("I would like you to put the bowl in the den in the fridge.", ["inside bowl_2 fridge_1"]),
        (
            "Put the apple in the fridge, then open the microwave.",
            ["inside apple_1 fridge_1", "open microwave_1"],
        ),
        (
            "Set the pear down on the desk and close the low cabinet.",
            ["ontop pear_1 desk_1", "not open bottom_cabinet_1"],
        ),
        (
            "Warm the pear with the microwave, then set it down on the desk.",
            ["hot pear_1 microwave_1", "ontop pear_1 desk_1"],
        ),
        ("Set the apple and the pear down on the desk.", ["ontop apple_1 desk_1", "ontop pear_1 desk_1"]),
        ("Set both bowls down on the desk.", ["ontop bowl_1 desk_1", "ontop bowl_2 desk_1"]),
        ("Set the bowl on the coffee table down on the desk.", ["ontop bowl_2 desk_1"]),
        ("Mia is tired. Put the apple in the fridge, please.", ["inside apple_1 fridge_1"]),
    ],
)
def test_known_phrases_are_read_about_other_objects(script, instruction, demands) -> None:
    assert demanded(script, instruction) == demands


@pytest.mark.parametrize(
    ("instruction", "demands"),
    [
        ("Kindly put the pear right in the fridge.", ["inside pear_1 fridge_1"]),
        ("Set the apple gently down on the cabinet.", ["ontop apple_1 bottom_cabinet_1"]),
        ("Would you warm up the pear with the microwave?", ["hot pear_1 microwave_1"]),
    ],
)
def test_similar_phrases_are_read_by_their_words(script, instruction, demands) -> None:
    assert demanded(script, instruction) == demands


def test_everyday_name_is_learned_from_demands_without_a_known_name(script) -> None:
    shut = IntentClause("open", ("bottom_cabinet_1",), holds=False)
    told = [
        example(f"wall-{at}", f"{verb} the wall unit.", (shut,)) for at, verb in enumerate(("Shut", "Close"))
    ]
    assert demanded(TemplateScript.fit([*training(), *told]), "Shut the wall unit.") == [
        "not open bottom_cabinet_1"
    ]
    assert demanded(script, "Shut the wall unit.") == []


def test_closed_containers_are_opened_before_the_object_is_fetched(script) -> None:
    plan = script.plan(situation("Put the pear in the microwave."))
    assert in_words(plan) == (
        "move microwave_1; open microwave_1; move fridge_1; open fridge_1; move pear_1; pick_up pear_1; "
        "move microwave_1; place microwave_1 inside"
    )


def test_door_is_closed_and_machine_switched_on_after_food_is_put_in(script) -> None:
    plan = script.plan(situation("Warm the apple with the microwave."))
    assert in_words(plan).endswith("place microwave_1 inside; close microwave_1; toggle_on microwave_1")


def test_machine_is_switched_off_before_it_is_opened_again(script) -> None:
    plan = script.plan(situation("Warm the apple with the microwave, then set it down on the desk."))
    assert "toggle_on microwave_1; toggle_off microwave_1; open microwave_1; move apple_1" in in_words(plan)


def test_source_that_no_word_names_is_the_one_of_the_training_plans(script) -> None:
    assert "place microwave_1 inside" in in_words(script.plan(situation("Please cook the pear.")))


def test_doors_are_closed_after_objects_are_put_behind_them(script) -> None:
    plan = script.plan(situation("Close the low cabinet and put the apple in the low cabinet."))
    assert in_words(plan).endswith("place bottom_cabinet_1 inside; close bottom_cabinet_1")


def test_open_door_is_not_opened_again(script) -> None:
    plan = script.plan(situation("Put the apple in the fridge.", in_state("fridge_1", "open")))
    assert in_words(plan) == "move apple_1; pick_up apple_1; move fridge_1; place fridge_1 inside"


def test_instruction_without_a_known_word_gives_a_plan_that_does_nothing(script) -> None:
    assert in_words(script.plan(situation("Good morning!"))) == "move countertop_1"


def test_mention_that_training_demands_nothing_of_is_no_demand() -> None:
    told = [
        example(f"t{at}", f"The {noun} was a gift. Open the fridge.", (IntentClause("open", ("fridge_1",)),))
        for at, noun in enumerate(("bowl", "apple", "pear"))
    ]
    script = TemplateScript.fit(told)
    assert demanded(script, "The desk was a gift. Open the microwave.") == ["open microwave_1"]
