"""Pairs that a goal wants next to each other get suitable poses, so that a plan can succeed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from tests.fakes.problems import source

from embomatrix.factory.pipeline.task_poses import NeighbourPair
from embomatrix.factory.task_import.batch import Verified, verify_first
from embomatrix.factory.task_import.neighbours import neighbours_of
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.world.bddl import parse_formula

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene

TYPES = {"cup": ("cup_1", "cup_2"), "lamp": ("lamp_1",), "stove": ("stove_1",)}
NAMES = {name: kind for kind, names in TYPES.items() for name in names}
PROBLEM = """(define (problem lay_the_money_down) (:domain omnigibson)
    (:objects money.n.01_1 money.n.01_2 - money.n.01 notebook.n.01_1 - notebook.n.01
        breakfast_table.n.01_1 - breakfast_table.n.01 stove.n.01_1 - stove.n.01 bucket.n.01_1 - bucket.n.01
        floor.n.01_1 - floor.n.01 agent.n.01_1 - agent.n.01)
    (:init (ontop money.n.01_1 stove.n.01_1) (ontop money.n.01_2 stove.n.01_1)
        (ontop notebook.n.01_1 breakfast_table.n.01_1) (ontop bucket.n.01_1 floor.n.01_1)
        (inroom breakfast_table.n.01_1 kitchen) (inroom stove.n.01_1 kitchen)
        (inroom floor.n.01_1 kitchen) (ontop agent.n.01_1 floor.n.01_1))
    (:goal {goal}))"""


@pytest.mark.parametrize(
    ("goal", "pairs"),
    [
        ("(nextto cup_1 lamp_1)", (NeighbourPair("cup_1", "lamp_1"),)),
        ("(nextto stove_1 cup_1)", (NeighbourPair("cup_1", "stove_1"),)),
        ("(not (nextto cup_1 lamp_1))", ()),
        (
            "(forall (?cup - cup) (nextto ?cup stove_1))",
            (NeighbourPair("cup_1", "stove_1"), NeighbourPair("cup_2", "stove_1")),
        ),
        (
            "(and (nextto cup_1 lamp_1) (ontop cup_1 stove_1) (ontop lamp_1 stove_1))",
            (NeighbourPair("cup_1", "lamp_1", "stove_1"),),
        ),
        ("(and (nextto cup_1 lamp_1) (ontop cup_1 stove_1) (ontop lamp_1 cup_2))", ()),
        (
            "(and (nextto cup_1 lamp_1) (ontop lamp_1 stove_1))",
            (NeighbourPair("cup_1", "lamp_1", "stove_1"),),
        ),
        ("(and (nextto cup_1 lamp_1) (ontop cup_1 stove_1))", (NeighbourPair("lamp_1", "cup_1", "stove_1"),)),
        ("(and (nextto cup_1 stove_1) (ontop cup_1 lamp_1))", (NeighbourPair("cup_1", "stove_1"),)),
        ("(nextto stove_1 stove_1)", ()),
    ],
)
def test_carried_object_goes_beside_a_static_or_carried_neighbour(
    goal: str, pairs: tuple[NeighbourPair, ...]
) -> None:
    formula = parse_formula(goal, NAMES)
    assert neighbours_of(formula, TYPES, lambda name: not name.startswith("stove")) == pairs


@pytest.mark.parametrize(
    "goal",
    [
        "(forall (?money.n.01 - money.n.01) (nextto ?money.n.01 notebook.n.01_1))",
        "(nextto bucket.n.01_1 stove.n.01_1)",
        """(and (nextto money.n.01_1 money.n.01_2)
            (forall (?money.n.01 - money.n.01) (ontop ?money.n.01 breakfast_table.n.01_1)))""",
        """(and (nextto money.n.01_1 notebook.n.01_1) (ontop money.n.01_1 stove.n.01_1)
            (ontop notebook.n.01_1 stove.n.01_1))""",
    ],
    ids=["on a table", "on the floor", "two alike that are carried", "two others that are carried"],
)
def test_plan_brings_objects_next_to_each_other(home: Scene, goal: str) -> None:
    outcome = verify_first(source(PROBLEM.format(goal=goal)), [home], PlacementLibrary(), None)
    assert isinstance(outcome, Verified), outcome
    assert "nextto" in outcome.record.signature
