"""Problems of other datasets: renamed types, type groups, implied rooms, EAI's tasks, and the import report."""

import dataclasses
import json
import time
from pathlib import Path

import pytest
from tests.fakes.problems import PROBLEM, source

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.task_import.batch import bind_first
from embomatrix.factory.task_import.dialects import (
    GROUPS,
    LAMPS,
    RENAMED,
    read_problem,
    translate_types,
    with_implied_rooms,
)
from embomatrix.factory.task_import.reach import unreachable_atoms
from embomatrix.factory.task_import.report import (
    ImportScope,
    ProblemOutcome,
    evaluation_of,
    outcome_of,
    report_to_json,
    report_to_markdown,
    solved_of,
)
from embomatrix.factory.task_import.sources import (
    EAI_INSTRUCTIONS,
    EAI_PROBLEMS,
    ProblemSourceError,
    read_eai,
)
from embomatrix.factory.task_import.task import ImportedTask, ImportOptions, import_problem
from embomatrix.world.bddl import InitLiteral, parse_formula, parse_problem
from embomatrix.world.catalog import Catalog
from embomatrix.world.goal import Atom
from embomatrix.world.scene import Scene
from embomatrix.world.task import Profile

EVALUABLE = ImportOptions(reachable=False)


def test_renamed_types_are_translated() -> None:
    text, notes = translate_types(PROBLEM.replace("breakfast_table.n.01", "cupboard.n.01"), RENAMED)
    assert "cupboard.n.01_1 - cabinet.n.01" in text
    assert notes == ("cupboard.n.01 is read as cabinet.n.01",)


def test_run_of_hyphens_is_searched_in_linear_time() -> None:
    began_s = time.process_time()
    assert translate_types("-" * 500_000, GROUPS) == ("-" * 500_000, ())
    assert time.process_time() - began_s < 5.0


def test_group_is_replaced_by_a_type_that_the_problem_does_not_name() -> None:
    text = "hardback.n.01_1 - hardback.n.01 book.n.02_1 - book.n.02"
    assert (
        translate_types(text, GROUPS)[0]
        == "hardback.n.01_1 - hardback.n.01 book.n.02_1 - paperback_book.n.01"
    )


def test_switched_light_becomes_a_lamp_but_ceiling_light_does_not() -> None:
    text = PROBLEM.replace("breakfast_table.n.01", "room_light.n.01")
    problem, notes = read_problem(source(text))
    assert problem.objects["room_light.n.01_1"] == "room_light.n.01"
    assert notes == ()
    problem, notes = read_problem(source(text.replace("(and\n", "(and (toggled_on ?room_light.n.01_1)\n")))
    assert problem.objects["room_light.n.01_1"] == "floor_lamp.n.01"
    assert notes == ("room_light.n.01 is read as floor_lamp.n.01",)


def test_driveway_is_floor(home: Scene) -> None:
    text = PROBLEM.replace("floor.n.01_1 - floor.n.01", "driveway.n.01_1 - driveway.n.01").replace(
        "floor.n.01_1", "driveway.n.01_1"
    )
    imported = import_problem(
        source(text.replace("apple.n.01_2 breakfast_table.n.01_1", "apple.n.01_2 driveway.n.01_1")), home
    )
    assert isinstance(imported, ImportedTask)
    apple = imported.scene.by_name[imported.about[imported.instances.index("apple.n.01_2")]]
    assert (apple.room, apple.host) == ("kitchen_0", "")


def test_every_type_translates_to_types_with_models() -> None:
    catalog = Catalog.load()
    for options in (*GROUPS.values(), *LAMPS.values()):
        for name in options:
            assert catalog.has_synset(name), name
            assert catalog.categories_of(name), name


def test_implied_rooms_are_added() -> None:
    text = PROBLEM.replace("(ontop apple.n.01_2 breakfast_table.n.01_1)", "(inside apple.n.01_2 closet_1)")
    problem, notes = with_implied_rooms(parse_problem(text))
    assert InitLiteral(Atom("inroom", ("apple.n.01_2", "closet_1"))) in problem.init
    assert notes == ("(inside apple.n.01_2 closet_1) is read as being in the room",)
    assert with_implied_rooms(problem) == (problem, ())


def test_floor_without_a_room_gets_the_room_of_objects_on_it() -> None:
    text = PROBLEM.replace(
        "(inroom floor.n.01_1 kitchen)", "(inroom apple.n.01_1 kitchen) (ontop apple.n.01_1 floor.n.01_1)"
    )
    problem, notes = with_implied_rooms(parse_problem(text))
    assert InitLiteral(Atom("inroom", ("floor.n.01_1", "kitchen"))) in problem.init
    assert len(notes) == 1


def test_unreachable_goal_is_bound_when_only_evaluation_is_needed(home: Scene) -> None:
    item = source(
        PROBLEM.replace("(not (open ?electric_refrigerator.n.01_1))", "(sliced ?breakfast_table.n.01_1)")
    )
    refused = import_problem(item, home)
    assert isinstance(refused, TaskRefusal)
    assert refused.reason is RefusalReason.INEXPRESSIBLE
    assert isinstance(import_problem(item, home, options=EVALUABLE), ImportedTask)
    folded = import_problem(
        source(PROBLEM.replace("(not (open ?", "(not (folded ?")), home, options=EVALUABLE
    )
    assert isinstance(folded, TaskRefusal)


def test_unreachable_atoms_are_listed_with_their_sign() -> None:
    problem = parse_problem(PROBLEM)
    goal = parse_formula(
        "(and (sliced apple.n.01_1) (forall (?a - apple.n.01) (not (folded ?a))) (ontop apple.n.01_2 breakfast_table.n.01_1))",
        problem.objects,
    )
    problem = dataclasses.replace(problem, goal=goal)
    assert unreachable_atoms(problem, Profile.PAPER) == ("(sliced apple.n.01_1)", "(not (folded ?a))")
    assert unreachable_atoms(problem, Profile.HOUSEHOLD) == ("(not (folded ?a))",)


EAI_PROBLEM = """(define (problem toys_0) (:domain igibson)
    (:objects plaything.n.01_1 - plaything.n.01 table.n.02_1 - table.n.02 floor.n.01_1 - floor.n.01 agent.n.01_1 - agent.n.01)
    (:init (onfloor plaything.n.01_1 floor.n.01_1) (dusty table.n.02_1) (inroom table.n.02_1 living_room)
        (inroom floor.n.01_1 living_room) (onfloor agent.n.01_1 floor.n.01_1))
    (:goal (and (forall (?plaything.n.01 - plaything.n.01) (ontop ?plaything.n.01 ?table.n.02_1))
        (not (dusty table.n.02_1)))))"""


@pytest.fixture
def eai(tmp_path: Path) -> Path:
    """Folder like the unpacked wheel, with one task."""
    root = tmp_path / "behavior_eval"
    files = {
        "data/demo_stats.json": json.dumps(
            {"toys_0_Rs_int": {"task": "toys", "task_id": 0, "scene_id": "Rs_int"}}
        ),
        f"{EAI_INSTRUCTIONS}": json.dumps({"toys": "Put the toys on the dusted table."}),
        f"{EAI_PROBLEMS}/toys_0_Rs_int.pddl": EAI_PROBLEM,
    }
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return tmp_path


def test_eai_task_is_bound_to_its_own_scene(eai: Path, flat: Scene, home: Scene) -> None:
    (item,) = read_eai(eai)
    imported = bind_first(item, [home, flat], options=EVALUABLE)
    assert isinstance(imported, ImportedTask)
    assert imported.scene.base == "Rs_int"
    assert imported.task.instruction == "Put the toys on the dusted table."
    outcome = outcome_of(item, imported, ["Rs_int"])
    assert outcome.unreachable == {"paper": ("(not (dusty table.n.02_1))",), "household": ()}
    assert "plaything.n.01 is read as toy_figure.n.01" in outcome.notes


def test_report_counts_refusals_and_lists_unreachable_goals(eai: Path, flat: Scene) -> None:
    (item,) = read_eai(eai)
    bound = outcome_of(item, bind_first(item, [flat], options=EVALUABLE), ["Rs_int"])
    refused = outcome_of(item, TaskRefusal(RefusalReason.DOES_NOT_FIT, "no room"), ["Rs_int"])
    summary = report_to_json([bound, refused])
    assert (summary["problems"], summary["bound"], summary["refused"]) == (2, 1, {"does_not_fit": 1})
    text = report_to_markdown([bound, refused])
    assert "* `toys` (does_not_fit): no room" in text
    assert "## Goals that the profile `paper` does not reach: 2" in text
    rate = evaluation_of([bound, refused], 0).figure("import_rate_eai")
    assert (rate.value, rate.goal, rate.n) == (0.5, 1.0, 2)


def test_only_rates_of_all_problems_have_goals_and_conditions_name_filters() -> None:
    bound = ProblemOutcome("a", "behavior-1k", "", "", "", {"paper": (), "household": ()}, (), (), True)
    names = ("import_rate_behavior", "faithful_share_behavior")
    whole = evaluation_of([bound], 3, ImportScope("instantiate", ("Rs_int", "Merom_0_int")))
    assert whole.conditions == {"seed": 3, "depth": "instantiate", "base scenes": "Rs_int, Merom_0_int"}
    assert [whole.figure(name).goal for name in names] == [0.6, 0.6]
    five = ("Rs_int",) * 5
    paper = evaluation_of([bound], 0, ImportScope("instantiate", five, Profile.PAPER, solids=True))
    assert paper.conditions["base scenes"] == 5
    assert paper.conditions["problems"] == "reached by paper and without liquids"
    for scope in (ImportScope("instantiate", five, Profile.PAPER), ImportScope("bind", five)):
        assert [evaluation_of([bound], 0, scope).figure(name).goal for name in names] == [None, None]
    solved = solved_of([bound], 0, ImportScope("verify", five, Profile.PAPER))
    assert [(figure.name, figure.goal) for figure in solved.figures] == [
        ("oracle_solved_behavior of what paper reaches", 0.95)
    ]
    assert solved.conditions["problems"] == "reached by paper"


def test_solved_share_counts_reachable_goals_only() -> None:
    solved, stuck, beyond = (
        ProblemOutcome(name, "behavior-1k", "", reason, "", {"paper": atoms, "household": ()}, ())
        for name, reason, atoms in (("a", "", ()), ("b", "no_plan", ()), ("c", "", ("(cut apple)",)))
    )
    evaluation = solved_of([solved, stuck, beyond], 0)
    summary = [(figure.name, figure.value, figure.goal, figure.n) for figure in evaluation.figures]
    without = solved_of([solved], 0, ImportScope(solids=True)).figures[0].name
    assert without == "oracle_solved_behavior of what paper reaches without liquids"
    assert summary == [
        ("oracle_solved_behavior of what paper reaches", 1 / 2, 0.95, 2),
        ("oracle_solved_behavior of what household reaches", 2 / 3, None, 3),
    ]


def test_folder_without_eai_files_is_rejected_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ProblemSourceError, match=r"can't be read|contains no tasks of EAI"):
        read_eai(tmp_path)


def test_renumbered_rooms_may_differ(home: Scene) -> None:
    other = source(PROBLEM.replace(" kitchen)", " kitchen_7)"))
    assert isinstance(import_problem(other, home), TaskRefusal)
    found = bind_first(other, [home])
    assert isinstance(found, ImportedTask)
    assert "kitchen_7 is read as kitchen_0" in found.notes


def test_missing_room_type_is_replaced_by_a_similar_one_last(home: Scene) -> None:
    text = PROBLEM.replace(
        "(ontop apple.n.01_2 breakfast_table.n.01_1)", "(inroom apple.n.01_2 television_room_0)"
    )
    found = bind_first(source(text), [home])
    assert isinstance(found, ImportedTask)
    assert "television_room_0 is read as living_room_0" in found.notes
