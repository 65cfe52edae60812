"""Instruction and goal must demand the same, and the words must not fit other objects."""

from dataclasses import replace

import pytest
from tests.fakes.plans import task_over
from tests.fakes.scenes import kitchen_scene

from embomatrix.factory.faithfulness.instruction import audit, read_intent
from embomatrix.factory.scenes.view import SceneView
from embomatrix.world.bddl import parse_formula
from embomatrix.world.intent import IntentClause

SCENE = kitchen_scene()
VIEW = SceneView(SCENE)


def task_of(instruction, goal):
    plain = task_over(SCENE)
    names = {item.name: SCENE.asset_of(item.name).synset for item in SCENE.objects}
    return replace(plain, instruction=instruction, goal=parse_formula(goal, names), goal_bddl=goal)


def findings(instruction, goal, *intent):
    return " | ".join(audit(task_of(instruction, goal), intent, VIEW))


HEATED = IntentClause("hot", ("apple_1",), ("microwave_1",))
PUT_IN = IntentClause("inside", ("apple_1",), ("fridge_1",))


@pytest.mark.parametrize(
    ("instruction", "goal", "intent"),
    [
        ("Heat the apple with the microwave.", "(hot apple_1 microwave_1)", [HEATED]),
        ("Heat the apple.", "(hot apple_1)", [IntentClause("hot", ("apple_1",))]),
        ("Put the apple in the fridge.", "(inside apple_1 fridge_1)", [PUT_IN]),
        (
            "Cook the apple and leave it in the microwave.",
            "(and (cooked apple_1) (inside apple_1 microwave_1))",
            [IntentClause("cooked", ("apple_1",)), IntentClause("inside", ("apple_1",), ("microwave_1",))],
        ),
        ("Shut the fridge.", "(not (open fridge_1))", [IntentClause("open", ("fridge_1",), holds=False)]),
        (
            "Put the apple in a fridge.",
            "(exists (?f - fridge.n.01) (inside apple_1 ?f))".replace(
                "fridge.n.01", SCENE.asset_of("fridge_1").synset
            ),
            [PUT_IN],
        ),
    ],
)
def test_faithful_task_has_no_finding(instruction, goal, intent):
    assert findings(instruction, goal, *intent) == ""


@pytest.mark.parametrize(
    ("instruction", "goal", "intent", "finding"),
    [
        (
            "Heat the apple with the microwave.",
            "(hot apple_1)",
            HEATED,
            "demands (hot apple_1 microwave_1), and the goal only (hot apple_1)",
        ),
        (
            "Heat the apple with the microwave.",
            "(hot apple_1)",
            IntentClause("hot", ("apple_1",)),
            "names microwave_1 as the source",
        ),
        (
            "Put the apple on the fridge.",
            "(inside apple_1 fridge_1)",
            PUT_IN,
            "says ontop fridge_1, and the goal inside",
        ),
        ("Put the apple away.", "(inside apple_1 fridge_1)", PUT_IN, "does not mention fridge_1"),
        ("Put apple_1 in the fridge.", "(inside apple_1 fridge_1)", PUT_IN, "names apple_1, an object"),
        (
            "Put the apple in the fridge.",
            "(and (inside apple_1 fridge_1) (open fridge_1))",
            PUT_IN,
            "the goal demands (open fridge_1), and the instruction does not",
        ),
    ],
)
def test_disagreement_is_named(instruction, goal, intent, finding):
    assert finding in findings(instruction, goal, intent)


def test_words_that_fit_a_second_object_are_reported():
    item = next(item for item in SCENE.objects if item.name == "apple_1")
    twin = replace(item, name="apple_9")
    view = SceneView(replace(SCENE, objects=(*SCENE.objects, twin)))
    found = audit(task_of("Put the apple in the fridge.", "(inside apple_1 fridge_1)"), [PUT_IN], view)
    assert found == ("the words for apple_1 also fit apple_9: say which, or accept any",)


def test_intent_of_an_older_task_is_read_from_its_goal_and_its_words():
    task = task_of("Heat the apple with the microwave.", "(hot apple_1)")
    assert read_intent(task, VIEW) == (HEATED,)
    task = task_of(
        "Cook the apple and leave it in the microwave.", "(and (cooked apple_1) (open microwave_1))"
    )
    assert read_intent(task, VIEW)[0].places == ("microwave_1",)
