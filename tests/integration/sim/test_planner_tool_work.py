"""The oracle planner reaches goals about substances and pieces, and names missing tools."""

import contextlib
from dataclasses import replace

import pytest
from tests.fakes.household import household_scene
from tests.fakes.plans import task_over, words_of

from embomatrix.sim.planner.oracle import PlanNotFound, find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.syntax import Skill
from embomatrix.world.bddl import parse_formula
from embomatrix.world.bundle import Bundle
from embomatrix.world.evaluate import evaluate
from embomatrix.world.task import Profile


@pytest.fixture(scope="module")
def home():
    with contextlib.closing(load_simulator(Bundle(household_scene(), {}))) as simulator:
        yield simulator


def task_of(home, goal, profile=Profile.HOUSEHOLD):
    scene = home.world.scene
    formula = parse_formula(goal, {item.name: "" for item in scene.objects})
    return replace(task_over(scene, formula), profile=profile)


GOALS = {
    "(sliced loaf_1)": "slice_object_with_tool loaf_1 table_knife_1",
    "(not (dusty plate_1))": "clean_object_with_tool plate_1 rag_1",
    "(not (covered plate_2 stain.n.01))": "clean_object_with_tool plate_2 liquid_soap__bottle_1",
    "(not (covered mug_1 mud.n.03))": "soak_object_in_source rag_1 sink_1",
    "(soaked rag_1)": "soak_object_in_source rag_1 sink_1",
    "(saturated rag_1 liquid_soap.n.01)": "soak_object_in_source rag_1 liquid_soap__bottle_1",
    "(filled cup_1 water.n.06)": "cup_1",
    "(real half_melon_1)": "slice_object_with_tool melon_1 table_knife_1",
    "(not (real melon_1))": "slice_object_with_tool melon_1 table_knife_1",
    "(ontop half_melon_2 coffee_table_1)": "slice_object_with_tool melon_1 table_knife_1",
    "(and (not (stained plate_2)) (inside plate_2 cabinet_1) (not (open cabinet_1)))": "plate_2",
    "(and (sliced loaf_1) (not (dusty plate_1)) (ontop loaf_1 coffee_table_1))": "loaf_1",
}


@pytest.mark.parametrize("goal", GOALS)
def test_household_goal_is_reached(home, goal):
    task = task_of(home, goal)
    plan = find_plan(home, task)
    assert not isinstance(plan, PlanNotFound), plan.reason
    assert home.execute(task, plan, 5).failure is None
    assert evaluate(task.goal, home.facts, task.types)
    assert GOALS[goal] in words_of(plan, task)


def test_one_cloth_is_soaked_once_for_several_objects(home):
    task = task_of(home, "(and (not (stained plate_2)) (not (stained plate_1)) (not (dusty plate_1)))")
    plan = find_plan(home, task)
    assert not isinstance(plan, PlanNotFound), plan.reason
    assert sum(call.skill is Skill.CLEAN for call in plan) == 2


def test_cup_is_filled_at_several_sources_without_being_put_down(home):
    task = task_of(home, "(and (filled cup_1 liquid_soap.n.01) (filled cup_1 water.n.06))")
    plan = find_plan(home, task)
    assert not isinstance(plan, PlanNotFound), plan.reason
    assert sum(call.skill is Skill.PICK_UP for call in plan) == 1


@pytest.mark.parametrize(
    ("goal", "profile", "reason"),
    [
        (
            "(not (dusty plate_1))",
            Profile.PAPER,
            "none of the skills can do this: plate_1 must be undone dusty",
        ),
        ("(dusty plate_2)", Profile.HOUSEHOLD, "none of the skills can do this: plate_2 must be made dusty"),
        (
            "(covered plate_2 salt.n.02)",
            Profile.HOUSEHOLD,
            "none of the skills can do this: plate_2 must be made covered salt",
        ),
        (
            "(not (covered vacuum_1 rust.n.01))",
            Profile.HOUSEHOLD,
            "nothing in the object table removes rust from vacuum_1",
        ),
        (
            "(sliced mug_1)",
            Profile.HOUSEHOLD,
            "nothing in the object table slices mug_1: expected a knife and a sliceable object",
        ),
        (
            "(saturated rag_1 acetone.n.01)",
            Profile.HOUSEHOLD,
            "nothing in the object table soaks or fills rag_1 with acetone",
        ),
    ],
)
def test_subgoal_without_a_method_is_refused_with_the_reason(home, goal, profile, reason):
    found = find_plan(home, task_of(home, goal, profile))
    assert isinstance(found, PlanNotFound)
    assert found.reason == reason
