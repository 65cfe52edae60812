"""Requested goal atoms are tested for feasibility in the simulator before they are written."""

from dataclasses import replace

import numpy as np
import pytest

from embomatrix.factory.pipeline.task_poses import SceneSurvey
from embomatrix.factory.scenes.feasibility import SimulatedRobot
from embomatrix.factory.scenes.view import CapableRobot, SceneView
from embomatrix.factory.writer.tasks import DraftOrder, PlainWriter
from embomatrix.factory.writer.variant import Variant
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import Handling
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation, State
from embomatrix.world.task import TaskCategory


@pytest.fixture(scope="module")
def parted(home: Scene) -> Scene:
    """Return the flat with a second fridge in the doorway between its rooms."""
    fridge = home.by_name["fridge_1"]
    (x, y), height = home.doorways[0].center_m, fridge.pose_world_asset.position_m[2]
    other = replace(fridge, name="fridge_2", pose_world_asset=Pose.from_xyz_yaw(x, y, height, 0.0))
    return replace(home, objects=(*home.objects, other))


def test_unreachable_furniture_is_infeasible_as_source_and_target(parted: Scene) -> None:
    with SimulatedRobot(parted) as robot:
        assert robot.can_pick_up("apple_1")
        assert not robot.can_pick_up("apple_2")
        assert robot.can_place("apple_1", Relation.ONTOP, "countertop_1")
        assert not robot.can_place("apple_1", Relation.ONTOP, "coffee_table_1")


def test_fulfilled_wish_is_infeasible(home: Scene) -> None:
    with SimulatedRobot(home) as robot:
        assert robot.can_swing("fridge_1", shut=False)
        assert not robot.can_swing("fridge_1", shut=True)
        assert robot.can_switch("stove_1", on=True)
        assert not robot.can_switch("stove_1", on=False)
        assert not robot.can_place("apple_1", Relation.ONTOP, "breakfast_table_1")
        assert robot.can_treat("apple_1", "fridge_1", State.FROZEN)
        assert not robot.can_treat("chicken_leg_1", "fridge_1", State.FROZEN)
        assert robot.can_treat("chicken_leg_1", "microwave_1", State.HOT)


def test_blocked_arm_makes_a_wish_infeasible(home: Scene) -> None:
    with SimulatedRobot(home, lambda handled: (Handling.OPEN, "fridge_1") in handled) as robot:
        assert robot.can_pick_up("apple_1")
        assert not robot.can_pick_up("chicken_leg_1")
        assert not robot.can_treat("apple_1", "fridge_1", State.FROZEN)
        assert robot.can_treat("apple_1", "microwave_1", State.HOT)


class Clumsy(CapableRobot):
    """Robot that grasps only mugs and switches nothing."""

    def can_pick_up(self, thing: str) -> bool:
        return thing.startswith("mug")

    def can_place(self, thing: str, relation: Relation, host: str) -> bool:
        return self.can_pick_up(thing) and host == "cabinet_1"

    def can_switch(self, name: str, *, on: bool) -> bool:
        return False


def test_infeasible_wishes_are_never_written(home: Scene) -> None:
    view, rooms = SceneView(home, Clumsy()), tuple(room.name for room in home.rooms)
    variant = Variant(home, rooms, tuple(item.name for item in home.objects if not item.fixed))
    goals = {
        category: {
            draft.task.goal_bddl
            for seed in range(40)
            if (
                draft := PlainWriter().write(
                    variant, view, DraftOrder(category, "t", np.random.default_rng(seed))
                )
            )
        }
        for category in TaskCategory
    }
    assert goals[TaskCategory.PICK_AND_PLACE] == {"(inside mug_1 cabinet_1)", "(ontop mug_1 cabinet_1)"}
    assert goals[TaskCategory.APPLIANCE_USE]
    assert not any("toggled_on" in goal for goal in goals[TaskCategory.APPLIANCE_USE])
    assert not goals[TaskCategory.KITCHEN_OPERATION]


def test_survey_answers_do_not_depend_on_the_order_of_queries(home: Scene) -> None:
    names = ("apple_1", "stove_1")
    foresight = ReachabilitySurvey()
    with SceneSurvey(home, foresight) as at_once, SceneSurvey(home, foresight) as bit_by_bit:
        assert not bit_by_bit.blocks([(Handling.PRESS, "stove_1")])
        assert not bit_by_bit.blocks([(Handling.TAKE, "apple_1")])
        assert bit_by_bit.poses(names) == at_once.poses(names)
        assert set(bit_by_bit.poses(names[:1]).stands) == {"apple_1"}
