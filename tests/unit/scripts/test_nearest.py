"""Nearest-neighbour script, and scripts fitted to parts of a training split."""

import pytest
from tests.fakes.script_examples import example, in_words, situation, training

from embomatrix.scripts.examples import FOLDS, FittedScripts, fold_of
from embomatrix.scripts.nearest import NearestScript
from embomatrix.scripts.similarity import TermIndex, words_in


@pytest.fixture(scope="module")
def script():
    return NearestScript.fit(training())


def test_demands_of_the_nearest_instruction_are_met_with_other_objects(script) -> None:
    plan = script.plan(situation("Please put the bowl in the kitchen in the microwave."))
    assert in_words(plan) == (
        "move microwave_1; open microwave_1; move bowl_1; pick_up bowl_1; move microwave_1; place microwave_1 inside"
    )


def test_neighbour_with_another_number_of_objects_is_passed_over(script) -> None:
    plan = script.plan(situation("Put the apple in the fridge and switch on the floor lamp."))
    assert in_words(plan).endswith("place fridge_1 inside; move floor_lamp_1; toggle_on floor_lamp_1")


def test_neighbour_whose_demands_do_not_fit_the_objects_is_passed_over() -> None:
    switching = next(each for each in training() if "floor lamp" in each.situation.instruction)
    script = NearestScript.fit([switching])
    assert in_words(script.plan(situation("Put the pear in the low cabinet and switch on the desk."))) == (
        "move countertop_1"
    )


def test_ranking_puts_the_rarer_shared_words_first() -> None:
    index = TermIndex([words_in("put it down"), words_in("freeze it"), words_in("put it away")])
    assert index.ranked(words_in("freeze it now")) == [1, 0, 2]


def test_training_task_is_answered_by_a_script_that_never_saw_it() -> None:
    class Witness:
        """Script whose plan lists the tasks that it saw."""

        def __init__(self, examples) -> None:
            self.seen = tuple(each.task_id for each in examples)

        def plan(self, asked):
            return self.seen

    examples = training()
    scripts = FittedScripts(Witness, examples)
    everything = scripts.plan("held-out-1", examples[0].situation)
    assert set(everything) == {each.task_id for each in examples}
    for each in examples:
        seen = scripts.plan(each.task_id, each.situation)
        assert {fold_of(task_id) for task_id in set(everything) - set(seen)} == {fold_of(each.task_id)}
        assert each.task_id not in seen


def test_folds_depend_on_the_id_only_and_are_all_used() -> None:
    assert {fold_of(f"task-{number}") for number in range(100)} == set(range(FOLDS))
    assert fold_of("task-7") == fold_of(example("task-7", "Open the fridge.", ()).task_id)
