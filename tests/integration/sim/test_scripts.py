"""Calls of scripts, executed: work with tools reaches the demanded states."""

import contextlib
from dataclasses import replace

import pytest
from tests.fakes.household import household_scene
from tests.fakes.plans import task_over, words_of

from embomatrix.scripts.calls import Habits, ScriptDemand, plan_for
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.prompt import situation_of
from embomatrix.skills.syntax import Skill
from embomatrix.world.bddl import parse_formula
from embomatrix.world.bundle import Bundle
from embomatrix.world.evaluate import evaluate
from embomatrix.world.task import Profile

HABITS = Habits(
    {}, {Skill.SLICE: ("table_knife",), Skill.CLEAN: ("rag",), Skill.SOAK: ("sink",)}, frozenset()
)


@pytest.fixture(scope="module")
def home():
    with contextlib.closing(load_simulator(Bundle(household_scene(), {}))) as simulator:
        yield simulator


@pytest.mark.parametrize(
    ("goal", "demands", "call"),
    [
        ("(sliced loaf_1)", [("sliced", True, "loaf_1")], "slice_object_with_tool loaf_1 table_knife_1"),
        ("(not (dusty plate_1))", [("dusty", False, "plate_1")], "clean_object_with_tool plate_1 rag_1"),
        ("(not (stained plate_2))", [("stained", False, "plate_2")], "soak_object_in_source rag_1 sink_1"),
        ("(soaked rag_1)", [("soaked", True, "rag_1")], "soak_object_in_source rag_1 sink_1"),
        (
            "(and (sliced loaf_1) (not (dusty plate_1)) (ontop loaf_1 coffee_table_1))",
            [
                ("ontop", True, "loaf_1", "coffee_table_1"),
                ("dusty", False, "plate_1"),
                ("sliced", True, "loaf_1"),
            ],
            "place coffee_table_1 ontop",
        ),
    ],
)
def test_work_with_tools_reaches_the_demanded_states(home, goal, demands, call) -> None:
    scene = home.world.scene
    formula = parse_formula(goal, {item.name: "" for item in scene.objects})
    task = replace(task_over(scene, formula), profile=Profile.HOUSEHOLD)
    situation = situation_of(scene, task)
    rows = {row.name: row for row in situation.rows}
    asked = [
        ScriptDemand(predicate, holds, (rows[thing],), tuple(rows[place] for place in places))
        for predicate, holds, thing, *places in demands
    ]
    plan = plan_for(asked, situation, HABITS)
    trace = home.execute(task, plan, 5)
    assert trace.failure is None, trace.steps[-1].message
    assert evaluate(task.goal, home.facts, task.types)
    assert call in words_of(plan, task)
