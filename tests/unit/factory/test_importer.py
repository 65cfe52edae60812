"""BDDL is bound to a scene, or refused for one reason of a closed set with a sentence about the case."""

import contextlib
import json
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from tests.fakes.plans import plan_of
from tests.fakes.scenes import kitchen_scene

from embomatrix.factory.refusal import Refusal, RefusalReason, RefusedError
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.task_import.batch import Verified, bind_first, verify
from embomatrix.factory.task_import.binding import bind
from embomatrix.factory.task_import.expressible import check_expressible
from embomatrix.factory.task_import.reach import Horizon
from embomatrix.factory.task_import.scene import with_states
from embomatrix.factory.task_import.sources import (
    SourceError,
    SourceText,
    activity_names,
    read_activity,
    read_file,
    read_jsonl,
)
from embomatrix.factory.task_import.task import Imported, Manner, category_of, import_problem, instruction_of
from embomatrix.sim.engine import FLOOR
from embomatrix.sim.executor import Simulator
from embomatrix.sim.physical.survey import Foresight
from embomatrix.sim.pose_cache import PlacementLibrary
from embomatrix.world.bddl import BddlError, Literal, parse_formula, parse_problem
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle
from embomatrix.world.evaluate import evaluate
from embomatrix.world.goal import Atom
from embomatrix.world.inflation import bundle_digest
from embomatrix.world.scene import Scene
from embomatrix.world.state import State, SubstanceFact, SubstanceRelation
from embomatrix.world.task import Profile, TaskCategory

SAMPLE = Path(__file__).parents[4] / "shared" / "data" / "embomatrix_tasks_sample.jsonl"

PROBLEM = """(define (problem Put_the_apples_in_the_fridge_in_kitchen_0)
    (:domain omnigibson)
    (:objects
        apple.n.01_1 apple.n.01_2 - apple.n.01
        electric_refrigerator.n.01_1 - electric_refrigerator.n.01
        breakfast_table.n.01_1 - breakfast_table.n.01
        floor.n.01_1 - floor.n.01
        agent.n.01_1 - agent.n.01
    )
    (:init
        (ontop apple.n.01_1 breakfast_table.n.01_1)
        (ontop apple.n.01_2 breakfast_table.n.01_1)
        (inroom electric_refrigerator.n.01_1 kitchen)
        (inroom breakfast_table.n.01_1 kitchen)
        (open electric_refrigerator.n.01_1)
        (inroom floor.n.01_1 kitchen)
        (ontop agent.n.01_1 floor.n.01_1)
    )
    (:goal
        (and
            (forall (?apple.n.01 - apple.n.01) (inside ?apple.n.01 ?electric_refrigerator.n.01_1))
            (not (open ?electric_refrigerator.n.01_1))
        )
    )
)
"""


def source(text: str = PROBLEM) -> SourceText:
    return SourceText("apples", text, "file")


@pytest.fixture(scope="module")
def home() -> Scene:
    return kitchen_scene()


def refusal(text: str, scene: Scene) -> Refusal:
    outcome = import_problem(source(text), scene, manner=Manner(furnishing=False))
    assert isinstance(outcome, Refusal)
    return outcome


def test_problem_becomes_a_task_in_a_scene_of_its_own(home: Scene) -> None:
    imported = import_problem(source(), home)
    assert isinstance(imported, Imported)
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
def test_what_can_t_be_bound_is_refused_for_its_reason(home: Scene, reason: RefusalReason) -> None:
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


def test_misspelt_type_suggests_the_right_one(home: Scene) -> None:
    outcome = refusal(PROBLEM.replace("breakfast_table.n.01", "breakfast_tabel.n.01"), home)
    assert "did you mean breakfast_table.n.01" in outcome.sentence


def test_broken_text_is_an_error_with_its_line(home: Scene) -> None:
    with pytest.raises(BddlError, match="line"):
        import_problem(source(PROBLEM.replace("kitchen)", "kitchen", 1)), home)


def test_two_objects_of_a_type_need_two_of_the_scene_s(home: Scene) -> None:
    text = PROBLEM.replace("breakfast_table.n.01_1 -", "breakfast_table.n.01_1 breakfast_table.n.01_2 -")
    text = text.replace("(open elec", "(inroom breakfast_table.n.01_2 kitchen)\n        (open elec")
    assert refusal(text, home).reason is RefusalReason.NO_SCENE_OBJECT


def test_binding_is_by_ability_as_well_as_by_type(home: Scene) -> None:
    on = "(toggled_on electric_refrigerator.n.01_1)"
    problem = parse_problem(PROBLEM.replace("(not (open ?electric_refrigerator.n.01_1))", on))
    with pytest.raises(RefusedError, match="electric_refrigerator"):
        bind(problem, home, np.random.default_rng(0), furnishing=False)


def test_small_thing_of_the_room_that_the_scene_lacks_is_put_on_furniture_there(home: Scene) -> None:
    text = PROBLEM.replace("(ontop apple.n.01_2 breakfast_table.n.01_1)", "(inroom apple.n.01_2 living_room)")
    text = text.replace("apple.n.01_2", "tennis_ball.n.01_1").replace(
        "tennis_ball.n.01_1 - apple.n.01", "- apple.n.01\n        tennis_ball.n.01_1 - tennis_ball.n.01"
    )
    imported = import_problem(source(text), home)
    assert isinstance(imported, Imported)
    ball = imported.scene.by_name["tennis_ball_1"]
    assert ball.room == "living_room_0"
    assert ball.host in imported.scene.by_name


def test_what_the_start_places_nowhere_is_put_where_such_things_are(home: Scene) -> None:
    imported = import_problem(
        source(PROBLEM.replace("(ontop apple.n.01_2 breakfast_table.n.01_1)\n", "\n")), home
    )
    assert isinstance(imported, Imported)
    assert imported.scene.by_name["apple_4"].room == "kitchen_0"
    assert imported.scene.by_name["apple_4"].host


def test_furniture_that_the_room_lacks_is_brought_in_where_that_is_allowed(home: Scene) -> None:
    text = PROBLEM.replace("breakfast_table.n.01", "armchair.n.01")
    imported = import_problem(source(text), home)
    assert isinstance(imported, Imported)
    chair = imported.scene.by_name["armchair_1"]
    assert (chair.room, chair.fixed) == ("kitchen_0", True)
    assert imported.scene.by_name["apple_3"].host == "armchair_1"
    assert isinstance(import_problem(source(text), home, manner=Manner(furnishing=False)), Refusal)


def test_states_of_the_start_are_set_and_taken_away(home: Scene) -> None:
    literals = [
        Literal(Atom("hot", ("apple_1",))),
        Literal(Atom("open", ("fridge_1",))),
        Literal(Atom("open", ("microwave_1",)), positive=False),
        Literal(Atom("ontop", ("apple_1", "fridge_1"))),
    ]
    changed = with_states(home, literals)
    assert changed.by_name["apple_1"].states == {State.HOT}
    assert changed.by_name["fridge_1"].joints == (1.0,)
    assert changed.by_name["microwave_1"].joints == (0.0,)
    assert (
        with_states(changed, [Literal(Atom("hot", ("apple_1",)), positive=False)]).by_name["apple_1"].states
        == set()
    )


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("pick_up_the_mug.n.04_from_the_desk_in_kitchen_0", "Pick up the mug from the desk in kitchen_0."),
        ("go_to_the_living_room_0._Then_rest-0", "Go to the living_room_0. Then rest."),
        ("heat_the_bread_slice.n.01_1", "Heat the bread slice."),
        ("clean_all_4_frames", "Clean all 4 frames."),
    ],
)
def test_instruction_is_the_problem_s_name_in_words(name: str, expected: str) -> None:
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
def test_goal_tells_which_of_the_four_kinds_a_task_is(goal: str, category: TaskCategory) -> None:
    assert category_of(parse_formula(goal, {"a_1": "a", "b_1": "b"})) is category


def test_imported_task_is_verified_by_execution(home: Scene) -> None:
    text = PROBLEM.replace("electric_refrigerator.n.01", "microwave.n.02").replace(
        "apple.n.01_1 apple.n.01_2", "apple.n.01_1"
    )
    text = text.replace("(ontop apple.n.01_2 breakfast_table.n.01_1)\n", "")
    imported = import_problem(source(text), home)
    assert isinstance(imported, Imported)
    outcome = verify(imported, PlacementLibrary(), Foresight())
    assert isinstance(outcome, Verified), outcome
    assert [call["action"] for call in outcome.record.oracle][-1] == "close"


HOUSEHOLD = """(define (problem slice_an_apple_and_wipe_the_bowl)
    (:domain omnigibson)
    (:objects
        apple.n.01_1 - apple.n.01
        half__apple.n.01_1 half__apple.n.01_2 - half__apple.n.01
        table_knife.n.01_1 - table_knife.n.01
        rag.n.01_1 - rag.n.01
        plate.n.04_1 - plate.n.04
        dust.n.01_1 - dust.n.01
        water.n.06_1 - water.n.06
        salt.n.02_1 - salt.n.02
        salt__shaker.n.01_1 - salt__shaker.n.01
        breakfast_table.n.01_1 - breakfast_table.n.01
        floor.n.01_1 - floor.n.01
        agent.n.01_1 - agent.n.01
    )
    (:init
        (ontop apple.n.01_1 breakfast_table.n.01_1)
        (ontop table_knife.n.01_1 breakfast_table.n.01_1)
        (ontop rag.n.01_1 breakfast_table.n.01_1)
        (ontop plate.n.04_1 breakfast_table.n.01_1)
        (ontop salt__shaker.n.01_1 breakfast_table.n.01_1)
        (covered plate.n.04_1 dust.n.01_1)
        (saturated rag.n.01_1 water.n.06_1)
        (insource salt__shaker.n.01_1 salt.n.02_1)
        (future half__apple.n.01_1)
        (future half__apple.n.01_2)
        (inroom breakfast_table.n.01_1 kitchen)
        (inroom floor.n.01_1 kitchen)
        (ontop agent.n.01_1 floor.n.01_1)
    )
    (:goal
        (and
            (forall (?half__apple.n.01 - half__apple.n.01) (real ?half__apple.n.01))
            (not (covered ?plate.n.04_1 ?dust.n.01_1))
        )
    )
)
"""


def test_substances_and_halves_of_a_problem_are_in_the_scene_that_is_made(home: Scene) -> None:
    imported = import_problem(source(HOUSEHOLD), home)
    assert isinstance(imported, Imported), imported
    task, scene = imported.task, imported.scene
    assert task.profile is Profile.HOUSEHOLD
    assert task.goal_bddl == (
        "(and (forall (?half__apple.n.01 - half__apple.n.01) (real ?half__apple.n.01)) "
        "(not (covered plate_1 dust.n.01)))"
    )
    assert scene.by_name["apple_3"].pieces == ("half_apple_1", "half_apple_2")
    assert scene.by_name["half_apple_1"].absent
    assert {"half_apple_1", "half_apple_2", "rag_1"} <= set(task.table)
    assert scene.by_name["plate_1"].substances == {SubstanceFact(SubstanceRelation.COVERED, "dust.n.01")}
    salted = [
        item
        for item in scene.objects
        if SubstanceFact(SubstanceRelation.CONTAINS, "salt.n.02") in item.substances
    ]
    assert [scene.asset_of(item.name).synset for item in salted] == ["salt__shaker.n.01"]


def test_a_household_task_is_read_back_and_can_be_done(home: Scene) -> None:
    imported = import_problem(source(HOUSEHOLD), home)
    assert isinstance(imported, Imported)
    data = encode_bundle(Bundle(imported.scene, {imported.task.task_id: imported.task}))
    bundle = decode_bundle(data, digest=bundle_digest(data))
    task = bundle.tasks[imported.task.task_id]
    assert task == imported.task
    with contextlib.closing(Simulator(bundle)) as simulator:
        simulator.reset(task, 0)
        for literal in imported.init:
            assert simulator.facts.holds(literal.atom.predicate, literal.atom.args) is literal.positive, (
                literal
            )
        plan = plan_of(
            task,
            "move table_knife_1; pick_up table_knife_1; move apple_3; slice_object_with_tool apple_3 table_knife_1; "
            "move countertop_1; place countertop_1 ontop; move rag_1; pick_up rag_1; move plate_1; "
            "clean_object_with_tool plate_1 rag_1",
        )
        trace = simulator.execute(task, plan, 0)
        assert trace.failure is None, trace.steps[-1].message
        assert evaluate(task.goal, simulator.facts, task.types)


def test_a_wildcard_is_every_further_object_of_the_type_in_the_room(home: Scene) -> None:
    text = PROBLEM.replace("breakfast_table.n.01_1 -", "breakfast_table.n.01_1 breakfast_table.n.01_* -")
    text = text.replace("(open elec", "(inroom breakfast_table.n.01_* kitchen)\n        (open elec")
    binding = bind(parse_problem(text), home, np.random.default_rng(0))
    assert "breakfast_table.n.01_2" not in binding.problem.objects, "the flat has one table"
    fruit = text.replace("breakfast_table.n.01_*", "mug.n.04_*").replace(
        "breakfast_table.n.01_1 mug.n.04_* -", "mug.n.04_* - mug.n.04 breakfast_table.n.01_1 -"
    )
    fruit = fruit.replace("mug.n.04_* kitchen", "mug.n.04_* living_room")
    binding = bind(parse_problem(fruit), home, np.random.default_rng(0))
    assert binding.found["mug.n.04_1"] == "mug_1"


def test_a_floor_that_the_goal_is_about_becomes_an_object_that_can_be_wiped_and_stood_on(home: Scene) -> None:
    text = HOUSEHOLD.replace("(covered plate.n.04_1 dust.n.01_1)", "(covered floor.n.01_1 dust.n.01_1)", 1)
    text = text.replace(
        "(not (covered ?plate.n.04_1 ?dust.n.01_1))",
        "(not (covered ?floor.n.01_1 ?dust.n.01_1)) (ontop ?plate.n.04_1 ?floor.n.01_1)",
    )
    imported = import_problem(source(text), home)
    assert isinstance(imported, Imported), imported
    task = imported.task
    assert "(not (covered floors_1 dust.n.01)) (ontop plate_1 floors_1)" in task.goal_bddl
    assert imported.scene.by_name["floors_1"].fixed
    outcome = verify(imported, PlacementLibrary(), Foresight())
    assert isinstance(outcome, Verified), outcome
    assert {"clean_object_with_tool", "slice_object_with_tool"} <= {
        step["action"] for step in outcome.record.oracle
    }


def test_a_floor_is_no_obstacle_and_what_stands_in_its_room_is_on_it(home: Scene) -> None:
    text = PROBLEM.replace(
        "(not (open ?electric_refrigerator.n.01_1))", "(not (ontop ?apple.n.01_1 ?floor.n.01_1))"
    )
    imported = import_problem(source(text), home)
    assert isinstance(imported, Imported)
    with contextlib.closing(Simulator(Bundle(imported.scene, {}))) as simulator:
        engine = simulator.world.engine
        simulator.reset(imported.task, 0)
        assert not engine.penetrates("floors_1", ignore=frozenset({FLOOR}))
        standing = simulator.world.relations.resting_on("floors_1")
        assert {"fridge_1", "stove_1", "breakfast_table_1"} <= set(standing)
        assert not {"apple_3", "microwave_1", "shelf_1"} & set(standing)
        assert simulator.execute(imported.task, plan_of(imported.task, "move floors_1"), 0).failure is None
        assert simulator.facts.holds("ontop", ("fridge_1", "floors_1"))
        assert simulator.facts.holds("inroom", ("floors_1", "kitchen_0"))


REACHABLE: dict[str, bool] = {
    "(not (covered plate.n.04_1 dust.n.01_1))": True,
    "(covered plate.n.04_1 dust.n.01_1)": True,
    "(covered plate.n.04_1 salt.n.02_1)": False,
    "(contains salt__shaker.n.01_1 salt.n.02_1)": True,
    "(not (contains salt__shaker.n.01_1 salt.n.02_1))": False,
    "(soaked rag.n.01_1)": True,
    "(not (soaked rag.n.01_1))": False,
    "(not (soaked plate.n.04_1))": True,
    "(filled plate.n.04_1 water.n.06_1)": True,
    "(filled rag.n.01_1 water.n.06_1)": False,
    "(filled plate.n.04_1 salt.n.02_1)": False,
    "(real half__apple.n.01_1)": True,
    "(not (real apple.n.01_1))": True,
    "(not (real plate.n.04_1))": False,
    "(real water.n.06_1)": True,
    "(sliced apple.n.01_1)": True,
    "(sliced plate.n.04_1)": False,
    "(folded rag.n.01_1)": False,
    "(or (folded rag.n.01_1) (hot apple.n.01_1))": True,
    "(not (and (cooked apple.n.01_1) (folded rag.n.01_1)))": True,
    "(imply (dusty plate.n.04_1) (folded rag.n.01_1))": True,
    "(forall (?h - half__apple.n.01) (ontop ?h plate.n.04_1))": True,
    "(exists (?h - half__apple.n.01) (folded ?h))": False,
    "(forn (1) (?h - half__apple.n.01) (real ?h))": True,
    "(forn (3) (?h - half__apple.n.01) (real ?h))": False,
    "(forpairs (?h - half__apple.n.01) (?p - plate.n.04) (ontop ?h ?p))": True,
    "(forpairs (?h - half__apple.n.01) (?p - plate.n.04) (attached ?h ?p))": False,
}


@pytest.mark.parametrize("goal", REACHABLE)
def test_what_the_skills_can_bring_about_is_told_from_the_problem_alone(goal: str) -> None:
    problem = parse_problem(HOUSEHOLD)
    formula = parse_formula(goal, problem.objects)
    assert (Horizon(problem).obstacle(formula) is None) is REACHABLE[goal]


def test_as_many_goals_are_expressible_as_the_documentation_says() -> None:
    pytest.importorskip("bddl", reason="the bddl package is not installed")
    page = " ".join((Path(__file__).parents[3] / "docs" / "tasks.md").read_text().split())
    said = re.search(r"1,016 activities (\d+) pass these checks, of the paper's 400 sample tasks (\d+)", page)
    assert said

    def is_expressible(item: SourceText) -> bool:
        try:
            check_expressible(parse_problem(item.text))
        except RefusedError:
            return False
        return True

    assert sum(is_expressible(read_activity(name)) for name in activity_names()) == int(said[1])
    if SAMPLE.exists():
        assert sum(map(is_expressible, read_jsonl(SAMPLE))) == int(said[2])


def test_unknown_activity_suggests_a_close_name() -> None:
    pytest.importorskip("bddl", reason="the bddl package is not installed")
    with pytest.raises(SourceError, match="did you mean bringing_water"):
        read_activity("bringin_water")
    assert read_activity("bringing_water").request == "bringing water"
    assert len(activity_names()) >= 1016


def test_unreadable_sources_are_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="can't be read"):
        read_file(tmp_path / "missing.bddl")
    with pytest.raises(SourceError, match="can't be read"):
        list(read_jsonl(tmp_path / "missing.jsonl"))
    (tmp_path / "bad.jsonl").write_text(json.dumps({"name": "a", "bddl": PROBLEM}) + "\n{}\n")
    with pytest.raises(SourceError, match=r"bad.jsonl:2: expected an object"):
        list(read_jsonl(tmp_path / "bad.jsonl"))


@pytest.mark.skipif(
    not SAMPLE.exists(), reason="the sample of the paper's tasks is not beside the repository"
)
def test_tasks_of_the_paper_s_factory_are_bound_or_refused() -> None:
    bases = [build_base_scene("Rs_int"), build_base_scene("Wainscott_0_int")]
    outcomes = [bind_first(item, bases) for item in list(read_jsonl(SAMPLE))[::8]]
    counts = Counter(item.reason if isinstance(item, Refusal) else "bound" for item in outcomes)
    assert counts["bound"] >= 3
    assert sum(counts.values()) == 50


def test_activities_of_behavior_1k_are_bound_or_refused() -> None:
    pytest.importorskip("bddl", reason="the bddl package is not installed")
    base = build_base_scene("Wainscott_0_int")
    names = activity_names()[::32]
    outcomes = [import_problem(read_activity(name), base) for name in names]
    bound = [item for item in outcomes if isinstance(item, Imported)]
    assert len(bound) >= 2
    for item in bound:
        assert item.task.source == "behavior-1k"
        assert set(item.task.table) <= set(item.scene.by_name)
