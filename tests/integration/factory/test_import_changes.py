"""Imports change as little as possible, say what they changed, and add only what a goal needs."""

import dataclasses

from tests.fakes.problems import PROBLEM, source

from embomatrix.factory.task_import.batch import bind_first
from embomatrix.factory.task_import.dialects import without_places_left
from embomatrix.factory.task_import.missing_sources import with_missing_sources
from embomatrix.factory.task_import.report import ProblemOutcome, evaluation_of, report_to_json
from embomatrix.factory.task_import.scene_changes import RoomStock, SceneChange, find_right_scene, lacking
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.factory.task_import.task import ImportedTask
from embomatrix.factory.task_import.task_fields import instruction_of
from embomatrix.world.bddl import parse_problem
from embomatrix.world.evaluate import render

TWO_ROOMS = parse_problem("""(define (problem p) (:domain omnigibson)
    (:objects sofa.n.01_1 sofa.n.01_2 - sofa.n.01 apple.n.01_1 - apple.n.01 bed.n.01_1 - bed.n.01)
    (:init (inroom sofa.n.01_1 living_room_0) (inroom sofa.n.01_2 living_room_0) (inroom bed.n.01_1 bedroom)
        (inroom apple.n.01_1 bedroom))
    (:goal (ontop apple.n.01_1 sofa.n.01_1)))""")


def test_lack_counts_missing_furniture_of_the_best_rooms() -> None:
    living, bare, bed = (
        RoomStock("living_room_0", "living_room", {"sofa": 1}),
        RoomStock("bedroom_0", "bedroom", {}),
        RoomStock("bedroom_1", "bedroom", {"bed": 1}),
    )
    assert lacking(TWO_ROOMS, (living, bare, bed)) == 1
    assert lacking(TWO_ROOMS, (living, bare)) == 2
    assert lacking(TWO_ROOMS, (bare, bed)) is None
    assert lacking(TWO_ROOMS, (dataclasses.replace(living, pieces={"sofa": 2}), bed)) == 0


def test_right_scene_is_one_that_the_author_names() -> None:
    text = PROBLEM.replace(" kitchen)", " kitchen_0)").replace("breakfast_table", "countertop")
    problem = parse_problem(text)
    named = SourceText("apple", text, "embomatrix", scenes=("Wainscott_0_int",))
    found = find_right_scene(source(text), problem, ["office_bike", "Wainscott_0_int"])
    assert found == find_right_scene(named, problem, ["office_bike", "Wainscott_0_int"]) == "Wainscott_0_int"
    assert find_right_scene(named, problem, ["office_bike"]) is None


def test_scene_without_changes_is_taken_before_one_with_added_furniture(home) -> None:
    fridge = next(item for item in home.objects if "fridge" in item.name or "refrigerator" in item.name)
    lacks = dataclasses.replace(
        home,
        base="bare",
        objects=tuple(item for item in home.objects if fridge.name not in (item.name, item.host)),
    )
    imported = bind_first(source(), [lacks, home])
    assert isinstance(imported, ImportedTask)
    assert (imported.scene.base, imported.changes) == (home.base, ())
    alone = bind_first(source(), [lacks])
    assert isinstance(alone, ImportedTask)
    assert SceneChange.FURNITURE_ADDED in alone.changes
    elsewhere = bind_first(dataclasses.replace(source(), scenes=("another",)), [home])
    assert isinstance(elsewhere, ImportedTask)
    assert elsewhere.changes == (SceneChange.OTHER_SCENE,)


def test_faithful_share_counts_problems_with_a_right_scene() -> None:
    reach: dict[str, tuple[str, ...]] = {"paper": (), "household": ()}
    added = (SceneChange.FURNITURE_ADDED,) * 2
    outcomes = [
        ProblemOutcome("a", "embomatrix", "Rs_int", "", "", reach, (), (), True),
        ProblemOutcome("b", "embomatrix", "Rs_int", "", "", reach, (), added, True),
        ProblemOutcome("c", "embomatrix", "Rs_int", "", "", reach, (), added, False),
        ProblemOutcome("d", "embomatrix", "", "does_not_fit", "no", reach, (), (), False),
    ]
    shares = evaluation_of(outcomes, 0)
    assert (shares.figure("faithful_share_sample").value, shares.figure("faithful_share_sample").n) == (
        0.5,
        2,
    )
    assert shares.figure("faithful_share_sample of all").value == 0.25
    report = report_to_json(outcomes)
    assert report["changed"] == {"furniture_added": 2}
    assert (report["faithful"], report["right_scene"], report["faithful_with_right_scene"]) == (1, 2, 1)


def test_instruction_names_the_rooms_of_the_scene() -> None:
    problem = parse_problem(PROBLEM)
    said = instruction_of(source(), problem, {"kitchen_0": "kitchen_1"})
    assert said == instruction_of(source(), problem).replace("kitchen_0", "kitchen_1")
    assert "kitchen_1" in said


def test_goal_that_repeats_the_start_is_read_without_it() -> None:
    text = PROBLEM[: PROBLEM.index("(:goal")]
    both = parse_problem(
        text + "(:goal (and (ontop apple.n.01_2 breakfast_table.n.01_1) (ontop apple.n.01_2 floor.n.01_1))))"
    )
    problem, notes = without_places_left(both)
    assert render(problem.goal) == "(and (ontop apple.n.01_2 floor.n.01_1))"
    assert "(ontop apple.n.01_2 breakfast_table.n.01_1) is left out of the goal" in notes[0]
    assert without_places_left(problem) == (problem, ())


def test_fridge_is_added_to_a_scene_without_cold_for_a_goal_that_needs_it(home) -> None:
    start = PROBLEM[: PROBLEM.index("(:goal")].replace("electric_refrigerator", "breakfast_table")
    problem = parse_problem(start + "(:goal (frozen apple.n.01_1)))")
    assert with_missing_sources(problem, home) == problem
    added = with_missing_sources(problem, dataclasses.replace(home, objects=()))
    assert set(added.objects.items()) - set(problem.objects.items()) == {
        ("electric_refrigerator.n.01_1", "electric_refrigerator.n.01")
    }
    assert ("electric_refrigerator.n.01_1", "kitchen") in added.initial_pairs("inroom")
