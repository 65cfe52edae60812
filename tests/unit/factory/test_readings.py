"""Readings: formulas of a reader who saw a prompt only, compared with the goal of its task."""

import pytest

from embomatrix.factory.evaluate.readings import is_equivalent, parse_goal, read_answers
from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.world.bddl import parse_formula
from embomatrix.world.task import Task, TaskCategory

TABLE = ("cup_1", "cup_2", "cup_3", "tray_1", "fridge_1", "saucer_1", "saucer_2")
OBJECTS = {name: name.rpartition("_")[0] for name in TABLE}
TYPES = {"cup": TABLE[:3], "saucer": TABLE[5:]}


def task(goal: str) -> Task:
    formula = parse_formula(goal, OBJECTS)
    return Task("t", "s", "", TaskCategory.PICK_AND_PLACE, formula, goal, TABLE, TYPES)


@pytest.mark.parametrize(
    ("goal", "stated"),
    [
        ("(inside cup_1 fridge_1)", "(inside 0 4)"),
        ("(and (inside cup_1 fridge_1) (not (open fridge_1)))", "(and (not (open 4)) (inside 0 4))"),
        ("(forall (?x - cup) (ontop ?x tray_1))", "(and (ontop 2 3) (ontop 0 3) (ontop 1 3))"),
        ("(exists (?x - cup) (ontop ?x tray_1))", "(or (ontop 0 3) (ontop 1 3) (ontop 2 3))"),
        ("(forn (2) (?x - cup) (ontop ?x tray_1))", "(exactly 2 (ontop 0 3) (ontop 1 3) (ontop 2 3))"),
        ("(forall (?x - cup) (not (ontop ?x tray_1)))", "(not (or (ontop 0 3) (ontop 1 3) (ontop 2 3)))"),
    ],
)
def test_an_equal_goal_in_other_words_agrees(goal: str, stated: str) -> None:
    assert is_equivalent(parse_goal(stated, TABLE), task(goal))


@pytest.mark.parametrize(
    ("goal", "stated"),
    [
        ("(inside cup_1 fridge_1)", "(inside 1 4)"),
        ("(inside cup_1 fridge_1)", "(and (inside 0 4) (not (open 4)))"),
        ("(forall (?x - cup) (ontop ?x tray_1))", "(and (ontop 2 3) (ontop 0 3))"),
        ("(forn (2) (?x - cup) (ontop ?x tray_1))", "(or (ontop 0 3) (ontop 1 3) (ontop 2 3))"),
        ("(forpairs (?x - cup) (?y - saucer) (ontop ?x ?y))", "(and (ontop 0 5) (ontop 1 6))"),
    ],
)
def test_another_goal_does_not_agree(goal: str, stated: str) -> None:
    assert not is_equivalent(parse_goal(stated, TABLE), task(goal))


@pytest.mark.parametrize(
    "text", ["inside 0 4", "(inside 0", "(inside 0 9)", "(and (inside 0 4)) )", "((inside 0 4))"]
)
def test_text_that_is_no_formula_is_quoted(text: str) -> None:
    with pytest.raises(EvaluationError, match="expected"):
        parse_goal(text, TABLE)


def test_a_broken_line_of_answers_is_named(tmp_path) -> None:
    path = tmp_path / "answers.jsonl"
    path.write_text('{"task": "a", "plan": "move 1"}\n\n{"plan": "x"}\n')
    with pytest.raises(EvaluationError, match=r"answers.jsonl:3 is no answer"):
        read_answers(path)
