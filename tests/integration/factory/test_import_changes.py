"""Imports change as little as possible, say what they changed, and add only what a goal needs."""

import dataclasses

import numpy as np
import pytest
from tests.fakes.problems import PROBLEM, source

from embomatrix.factory.admission import RefusedError
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.task_import.batch import bind_first
from embomatrix.factory.task_import.dialects import without_places_left
from embomatrix.factory.task_import.missing_sources import with_missing_sources
from embomatrix.factory.task_import.report import ProblemOutcome, evaluation_of, report_to_json
from embomatrix.factory.task_import.scene_changes import RoomStock, SceneChange, find_right_scene, lacking
from embomatrix.factory.task_import.search import BindingOptions, search
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.factory.task_import.task import ImportedTask, ImportOptions, import_problem
from embomatrix.factory.task_import.task_fields import instruction_of
from embomatrix.world.bddl import parse_problem
from embomatrix.world.evaluate import render
from embomatrix.world.scene import Scene

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


def test_fridge_is_added_to_a_scene_without_cold_for_a_goal_that_needs_it(home: Scene) -> None:
    start = PROBLEM[: PROBLEM.index("(:goal")].replace("electric_refrigerator", "breakfast_table")
    problem = parse_problem(start + "(:goal (frozen apple.n.01_1)))")
    assert with_missing_sources(problem, home) == problem
    added = with_missing_sources(problem, dataclasses.replace(home, objects=()))
    assert set(added.objects.items()) - set(problem.objects.items()) == {
        ("electric_refrigerator.n.01_1", "electric_refrigerator.n.01")
    }
    assert ("electric_refrigerator.n.01_1", "kitchen") in added.initial_pairs("inroom")


def test_oven_is_added_beside_a_microwave_for_food_that_it_only_warms(home: Scene) -> None:
    start = PROBLEM[: PROBLEM.index("(:goal")].replace("electric_refrigerator.n.01", "microwave.n.02")
    bare = dataclasses.replace(home, objects=())

    def added(food: str, state: str) -> set[str]:
        text = start.replace("apple.n.01", food) + f"(:goal ({state} {food}_1)))"
        problem = parse_problem(text)
        return set(with_missing_sources(problem, bare).objects) - set(problem.objects)

    assert added("tortilla.n.01", "cooked") == {"oven.n.01_1"}
    assert added("tortilla.n.01", "hot") == set()


def test_furniture_whose_doors_are_blocked_is_not_used(home: Scene) -> None:
    problem, view = parse_problem(PROBLEM), SceneView(home)
    inroom = dict(problem.initial_pairs("inroom"))
    fixtures = ["electric_refrigerator.n.01_1"]

    def found(options: BindingOptions) -> str:
        rng = np.random.default_rng(0)
        return search(problem, view, inroom, fixtures, rng, options, ())[1].get(fixtures[0], "")

    bare = BindingOptions(furnishing=False, usable=True)
    fridge = found(bare)
    assert fridge.startswith("fridge")
    view._opens[fridge] = False
    with pytest.raises(RefusedError, match="no free object for electric_refrigerator"):
        found(bare)
    assert found(BindingOptions(furnishing=False)) == fridge


def test_places_of_the_goal_are_cleared_of_background(flat: Scene) -> None:
    text = """(define (problem p) (:domain omnigibson)
        (:objects rag.n.01_1 - rag.n.01 sink.n.01_1 - sink.n.01 fridge - electric_refrigerator.n.01)
        (:init (inroom sink.n.01_1 kitchen) (inroom fridge kitchen) (inside rag.n.01_1 fridge))
        (:goal (inside rag.n.01_1 sink.n.01_1)))"""
    kept = import_problem(source(text), flat)
    cleared = import_problem(source(text), flat, options=ImportOptions(usable=True))
    assert isinstance(kept, ImportedTask)
    assert isinstance(cleared, ImportedTask)
    beside = {item for item in kept.scene.background if item.host == "furniture_sink_1"}
    assert len(beside) > 3
    assert set(kept.scene.background) - set(cleared.scene.background) == beside
