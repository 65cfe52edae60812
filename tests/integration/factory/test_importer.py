"""A BDDL problem is bound to a scene, or refused with one of a closed set of reasons."""

import numpy as np
import pytest
from tests.fakes.problems import PROBLEM, source

from embomatrix.factory.admission import RefusalReason, RefusedError, TaskRefusal
from embomatrix.factory.task_import.batch import Verified, verify
from embomatrix.factory.task_import.binding import bind
from embomatrix.factory.task_import.search import BindingOptions
from embomatrix.factory.task_import.start_state import with_states
from embomatrix.factory.task_import.task import ImportedTask, ImportOptions, import_problem
from embomatrix.factory.task_import.task_fields import instruction_of
from embomatrix.factory.writer.categories import category_of
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.world.bddl import BddlError, InitLiteral, parse_formula, parse_problem
from embomatrix.world.goal import Atom
from embomatrix.world.scene import Scene
from embomatrix.world.state import State
from embomatrix.world.task import TaskCategory


def refusal(text: str, scene: Scene) -> TaskRefusal:
    outcome = import_problem(source(text), scene, options=ImportOptions(furnishing=False))
    assert isinstance(outcome, TaskRefusal)
    return outcome


def test_problem_becomes_a_task_in_its_own_scene(home: Scene) -> None:
    imported = import_problem(source(), home)
    assert isinstance(imported, ImportedTask)
    task, scene = imported.task, imported.scene
    added = [item for item in scene.objects if item.name not in home.by_name]
    assert [(item.name, item.host) for item in added] == [
        ("apple_3", "breakfast_table_1"),
        ("apple_4", "breakfast_table_1"),
    ]
    assert task.types == {"apple.n.01": ("apple_3", "apple_4")}
    assert task.goal_bddl == (
        "(and (forall (?apple.n.01 - apple.n.01) (inside ?apple.n.01 fridge_1)) (not (open fridge_1)))"
    )
    assert scene.by_name["fridge_1"].joints == (1.0,)
    assert scene.robot.room == "kitchen_0"
    assert {"apple_3", "apple_4", "fridge_1", "breakfast_table_1"} <= set(task.table)
    assert task.category is TaskCategory.COMPOUND
    assert task.instruction == "Put the apples in the fridge in kitchen_0."
    assert imported.rooms == ("kitchen_0",)


def test_equal_seeds_bind_equally(home: Scene) -> None:
    assert import_problem(source(), home, seed=3) == import_problem(source(), home, seed=3)


def test_room_instance_pins_the_room(home: Scene) -> None:
    outcome = refusal(PROBLEM.replace("_1 kitchen)", "_1 kitchen_7)"), home)
    assert outcome.reason is RefusalReason.ROOM_MISSING
    assert "'kitchen_7'" in outcome.sentence
    assert "kitchen_0" in outcome.sentence


REFUSALS: dict[RefusalReason, tuple[str, str]] = {
    RefusalReason.UNKNOWN_TYPE: ("breakfast_table.n.01", "breakfast_tabel.n.01"),
    RefusalReason.SUBSTANCE: ("apple.n.01", "water.n.06"),
    RefusalReason.INEXPRESSIBLE: ("(not (open ?", "(not (folded ?"),
    RefusalReason.ROOM_MISSING: ("_1 kitchen)", "_1 sauna)"),
    RefusalReason.ROOM_AS_OBJECT: ("(not (open ?electric_refrigerator.n.01_1))", "(not (open closet_0))"),
    RefusalReason.AGENT_IN_GOAL: ("(not (open ?electric", "(nextto agent.n.01_1 electric"),
    RefusalReason.NO_SCENE_OBJECT: ("breakfast_table.n.01", "bed.n.01"),
    RefusalReason.NO_PLACE_GIVEN: (
        "(ontop apple.n.01_2 breakfast_table.n.01_1)",
        "(ontop apple.n.01_2 apple.n.01_2)",
    ),
    RefusalReason.DOES_NOT_FIT: ("apple.n.01", "sofa.n.01"),
}


@pytest.mark.parametrize("reason", REFUSALS)
def test_unbindable_problem_is_refused_with_its_reason(home: Scene, reason: RefusalReason) -> None:
    old, new = REFUSALS[reason]
    text = PROBLEM.replace(old, new)
    if reason is RefusalReason.AGENT_IN_GOAL:
        text = text.replace(
            "electric_refrigerator.n.01_1))\n        )", "electric_refrigerator.n.01_1)\n        )"
        )
    assert text != PROBLEM
    outcome = refusal(text, home)
    assert outcome.reason is reason
    assert len(outcome.sentence) > 25


def test_furniture_without_a_capable_model_is_refused_with_the_missing_ability(home: Scene) -> None:
    outcome = import_problem(source(PROBLEM.replace("electric_refrigerator", "sofa")), home)
    assert isinstance(outcome, TaskRefusal)
    assert outcome.reason is RefusalReason.DOES_NOT_FIT
    assert outcome.sentence == (
        "'sofa.n.01_1' has no place: its type has no model with the abilities that the task needs: container, openable"
    )


def test_misspelt_type_suggests_the_right_one(home: Scene) -> None:
    outcome = refusal(PROBLEM.replace("breakfast_table.n.01", "breakfast_tabel.n.01"), home)
    assert "did you mean breakfast_table.n.01" in outcome.sentence


def test_invalid_text_raises_with_its_line(home: Scene) -> None:
    with pytest.raises(BddlError, match="line"):
        import_problem(source(PROBLEM.replace("kitchen)", "kitchen", 1)), home)


def test_two_objects_of_a_type_need_two_scene_objects(home: Scene) -> None:
    text = PROBLEM.replace("breakfast_table.n.01_1 -", "breakfast_table.n.01_1 breakfast_table.n.01_2 -")
    text = text.replace("(open elec", "(inroom breakfast_table.n.01_2 kitchen)\n        (open elec")
    assert refusal(text, home).reason is RefusalReason.NO_SCENE_OBJECT


def test_binding_considers_abilities(home: Scene) -> None:
    on = "(toggled_on electric_refrigerator.n.01_1)"
    problem = parse_problem(PROBLEM.replace("(not (open ?electric_refrigerator.n.01_1))", on))
    with pytest.raises(RefusedError, match="electric_refrigerator"):
        bind(problem, home, np.random.default_rng(0), BindingOptions(furnishing=False))


def test_missing_small_object_is_placed_on_furniture_of_the_room(home: Scene) -> None:
    text = PROBLEM.replace("(ontop apple.n.01_2 breakfast_table.n.01_1)", "(inroom apple.n.01_2 living_room)")
    text = text.replace("apple.n.01_2", "tennis_ball.n.01_1").replace(
        "tennis_ball.n.01_1 - apple.n.01", "- apple.n.01\n        tennis_ball.n.01_1 - tennis_ball.n.01"
    )
    imported = import_problem(source(text), home)
    assert isinstance(imported, ImportedTask)
    ball = imported.scene.by_name["tennis_ball_1"]
    assert ball.room == "living_room_0"
    assert ball.host in imported.scene.by_name


def test_object_without_a_place_goes_to_usual_furniture(home: Scene) -> None:
    imported = import_problem(
        source(PROBLEM.replace("(ontop apple.n.01_2 breakfast_table.n.01_1)\n", "\n")), home
    )
    assert isinstance(imported, ImportedTask)
    assert imported.scene.by_name["apple_4"].room == "kitchen_0"
    assert imported.scene.by_name["apple_4"].host


def test_missing_furniture_is_added_if_allowed(home: Scene) -> None:
    text = PROBLEM.replace("breakfast_table.n.01", "armchair.n.01")
    imported = import_problem(source(text), home)
    assert isinstance(imported, ImportedTask)
    chair = imported.scene.by_name["armchair_1"]
    assert (chair.room, chair.fixed) == ("kitchen_0", True)
    assert imported.scene.by_name["apple_3"].host == "armchair_1"
    assert isinstance(
        import_problem(source(text), home, options=ImportOptions(furnishing=False)), TaskRefusal
    )


def test_start_states_are_set_and_cleared(home: Scene) -> None:
    literals = [
        InitLiteral(Atom("hot", ("apple_1",))),
        InitLiteral(Atom("open", ("fridge_1",))),
        InitLiteral(Atom("open", ("microwave_1",)), positive=False),
        InitLiteral(Atom("ontop", ("apple_1", "fridge_1"))),
    ]
    changed = with_states(home, literals)
    assert changed.by_name["apple_1"].states == {State.HOT}
    assert changed.by_name["fridge_1"].joints == (1.0,)
    assert changed.by_name["microwave_1"].joints == (0.0,)
    assert (
        with_states(changed, [InitLiteral(Atom("hot", ("apple_1",)), positive=False)])
        .by_name["apple_1"]
        .states
        == set()
    )


def test_start_state_of_a_substance_changes_no_object(home: Scene) -> None:
    assert with_states(home, [InitLiteral(Atom("cooked", ("rice.n.01",)))]) == home


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("pick_up_the_mug.n.04_from_the_desk_in_kitchen_0", "Pick up the mug from the desk in kitchen_0."),
        ("go_to_the_living_room_0._Then_rest-0", "Go to the living_room_0. Then rest."),
        ("heat_the_bread_slice.n.01_1", "Heat the bread slice."),
        ("clean_all_4_frames", "Clean all 4 frames."),
    ],
)
def test_instruction_is_the_problem_name_in_words(name: str, expected: str) -> None:
    problem = parse_problem(PROBLEM.replace("Put_the_apples_in_the_fridge_in_kitchen_0", name))
    assert instruction_of(source(), problem) == expected


@pytest.mark.parametrize(
    ("goal", "category"),
    [
        ("(ontop a_1 b_1)", TaskCategory.PICK_AND_PLACE),
        ("(not (open b_1))", TaskCategory.APPLIANCE_USE),
        ("(cooked a_1)", TaskCategory.KITCHEN_OPERATION),
        ("(and (hot a_1) (inside a_1 b_1) (toggled_on b_1))", TaskCategory.KITCHEN_OPERATION),
        ("(and (hot a_1) (ontop a_1 b_1))", TaskCategory.COMPOUND),
        ("(and (open b_1) (ontop a_1 b_1))", TaskCategory.COMPOUND),
    ],
)
def test_goal_determines_the_task_category(goal: str, category: TaskCategory) -> None:
    assert category_of(parse_formula(goal, {"a_1": "a", "b_1": "b"})) is category


def test_imported_task_is_verified_by_execution(home: Scene) -> None:
    text = PROBLEM.replace("electric_refrigerator.n.01", "microwave.n.02").replace(
        "apple.n.01_1 apple.n.01_2", "apple.n.01_1"
    )
    text = text.replace("(ontop apple.n.01_2 breakfast_table.n.01_1)\n", "")
    imported = import_problem(source(text), home)
    assert isinstance(imported, ImportedTask)
    outcome = verify(imported, PlacementLibrary(), ReachabilitySurvey())
    assert isinstance(outcome, Verified), outcome
    assert [call["action"] for call in outcome.record.oracle][-1] == "close"


def test_carried_appliance_becomes_movable_and_others_stay_fixed(home: Scene) -> None:
    text = """(define (problem move_the_toaster) (:domain omnigibson)
        (:objects toaster.n.02_1 - toaster.n.02 breakfast_table.n.01_1 - breakfast_table.n.01
            stove.n.01_1 - stove.n.01 floor.n.01_1 - floor.n.01 agent.n.01_1 - agent.n.01)
        (:init (ontop toaster.n.02_1 stove.n.01_1) (inroom stove.n.01_1 kitchen)
            (inroom breakfast_table.n.01_1 kitchen) (inroom floor.n.01_1 kitchen) (ontop agent.n.01_1 floor.n.01_1))
        (:goal (ontop ?toaster.n.02_1 ?{host})))"""
    loose = {}
    for host in ("breakfast_table.n.01_1", "stove.n.01_1"):
        imported = import_problem(source(text.format(host=host)), home)
        assert isinstance(imported, ImportedTask), imported
        loose[host] = not imported.scene.by_name["toaster_1"].fixed
    assert loose == {"breakfast_table.n.01_1": True, "stove.n.01_1": False}


def test_wildcard_stands_for_all_further_objects_of_the_type_in_the_room(home: Scene) -> None:
    text = PROBLEM.replace("breakfast_table.n.01_1 -", "breakfast_table.n.01_1 breakfast_table.n.01_* -")
    text = text.replace("(open elec", "(inroom breakfast_table.n.01_* kitchen)\n        (open elec")
    binding = bind(parse_problem(text), home, np.random.default_rng(0), BindingOptions())
    assert "breakfast_table.n.01_2" not in binding.problem.objects, "the flat has one table"
    fruit = text.replace("breakfast_table.n.01_*", "mug.n.04_*").replace(
        "breakfast_table.n.01_1 mug.n.04_* -", "mug.n.04_* - mug.n.04 breakfast_table.n.01_1 -"
    )
    fruit = fruit.replace("mug.n.04_* kitchen", "mug.n.04_* living_room")
    binding = bind(parse_problem(fruit), home, np.random.default_rng(0), BindingOptions())
    assert binding.found["mug.n.04_1"] == "mug_1"
