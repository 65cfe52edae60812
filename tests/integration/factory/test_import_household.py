"""Problems of the household profile: substances, halves, floors and reachability, bound and executed."""

import contextlib

import pytest
from tests.fakes.plans import plan_of
from tests.fakes.problems import PROBLEM, source

from embomatrix.factory.task_import.batch import Verified, verify
from embomatrix.factory.task_import.reach import Reachability
from embomatrix.factory.task_import.task import ImportedTask, import_problem
from embomatrix.sim.engine import FLOOR
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bddl import parse_formula, parse_problem
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle
from embomatrix.world.evaluate import evaluate
from embomatrix.world.inflation import bundle_digest
from embomatrix.world.scene import Scene
from embomatrix.world.state import SubstanceFact, SubstanceRelation
from embomatrix.world.task import Profile

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


def test_substances_and_halves_are_in_the_imported_scene(home: Scene) -> None:
    imported = import_problem(source(HOUSEHOLD), home)
    assert isinstance(imported, ImportedTask), imported
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


def test_household_task_round_trips_and_is_solvable(home: Scene) -> None:
    imported = import_problem(source(HOUSEHOLD), home)
    assert isinstance(imported, ImportedTask)
    data = encode_bundle(Bundle(imported.scene, {imported.task.task_id: imported.task}))
    bundle = decode_bundle(data, digest=bundle_digest(data))
    task = bundle.tasks[imported.task.task_id]
    assert task == imported.task
    with contextlib.closing(load_simulator(bundle)) as simulator:
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


def test_floor_in_the_goal_becomes_an_object_to_wipe_and_stand_on(home: Scene) -> None:
    text = HOUSEHOLD.replace("(covered plate.n.04_1 dust.n.01_1)", "(covered floor.n.01_1 dust.n.01_1)", 1)
    text = text.replace(
        "(not (covered ?plate.n.04_1 ?dust.n.01_1))",
        "(not (covered ?floor.n.01_1 ?dust.n.01_1)) (ontop ?plate.n.04_1 ?floor.n.01_1)",
    )
    imported = import_problem(source(text), home)
    assert isinstance(imported, ImportedTask), imported
    task = imported.task
    assert "(not (covered floors_1 dust.n.01)) (ontop plate_1 floors_1)" in task.goal_bddl
    assert imported.scene.by_name["floors_1"].fixed
    outcome = verify(imported, PlacementLibrary(), ReachabilitySurvey())
    assert isinstance(outcome, Verified), outcome
    assert {"clean_object_with_tool", "slice_object_with_tool"} <= {
        step["action"] for step in outcome.record.oracle
    }


def test_floor_is_no_obstacle_and_supports_objects_of_its_room(home: Scene) -> None:
    text = PROBLEM.replace(
        "(not (open ?electric_refrigerator.n.01_1))", "(not (ontop ?apple.n.01_1 ?floor.n.01_1))"
    )
    imported = import_problem(source(text), home)
    assert isinstance(imported, ImportedTask)
    with contextlib.closing(load_simulator(Bundle(imported.scene, {}))) as simulator:
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
def test_reachability_is_judged_from_the_problem_alone(goal: str) -> None:
    problem = parse_problem(HOUSEHOLD)
    formula = parse_formula(goal, problem.objects)
    assert (Reachability(problem).unreachable_part(formula) is None) is REACHABLE[goal]
