"""Wishes are tried before anybody writes them down, in the simulator that executes plans."""

from dataclasses import replace

import numpy as np
import pytest

from embomatrix.factory.pipeline.task_poses import SceneSurvey
from embomatrix.factory.scenes.rehearsal import Rehearsal
from embomatrix.factory.scenes.view import AnyRobot, SceneView
from embomatrix.factory.social.requests import RequestedAtom, TaskRequest, Wanted, check_request
from embomatrix.factory.writer.tasks import PlainWriter
from embomatrix.factory.writer.variant import Variant
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import Handling
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation, State
from embomatrix.world.task import TaskCategory


@pytest.fixture(scope="module")
def parted(home: Scene) -> Scene:
    """The flat with a second fridge in the doorway between its rooms."""
    fridge = home.by_name["fridge_1"]
    (x, y), height = home.doorways[0].center_m, fridge.pose_world_asset.position_m[2]
    other = replace(fridge, name="fridge_2", pose_world_asset=Pose.from_xyz_yaw(x, y, height, 0.0))
    return replace(home, objects=(*home.objects, other))


def test_what_is_served_from_nowhere_is_neither_fetched_nor_a_place_to_put_things(parted: Scene) -> None:
    with Rehearsal(parted) as robot:
        assert robot.fetches("apple_1")
        assert not robot.fetches("apple_2")
        assert robot.puts("apple_1", Relation.ONTOP, "countertop_1")
        assert not robot.puts("apple_1", Relation.ONTOP, "coffee_table_1")


def test_what_is_so_already_is_nothing_to_bring_about(home: Scene) -> None:
    with Rehearsal(home) as robot:
        assert robot.swings("fridge_1", shut=False)
        assert not robot.swings("fridge_1", shut=True)
        assert robot.switches("stove_1", on=True)
        assert not robot.switches("stove_1", on=False)
        assert not robot.puts("apple_1", Relation.ONTOP, "breakfast_table_1")
        assert robot.exposes("apple_1", "fridge_1", State.FROZEN)
        assert not robot.exposes("chicken_leg_1", "fridge_1", State.FROZEN)
        assert robot.exposes("chicken_leg_1", "microwave_1", State.HOT)


def test_what_bars_the_arm_on_the_way_to_a_wish_stands_against_it(home: Scene) -> None:
    with Rehearsal(home, lambda handled: (Handling.OPEN, "fridge_1") in handled) as robot:
        assert robot.fetches("apple_1")
        assert not robot.fetches("chicken_leg_1")
        assert not robot.exposes("apple_1", "fridge_1", State.FROZEN)
        assert robot.exposes("apple_1", "microwave_1", State.HOT)


class Clumsy(AnyRobot):
    """Gets hold of nothing but mugs, and switches nothing."""

    def fetches(self, thing: str) -> bool:
        return thing.startswith("mug")

    def puts(self, thing: str, relation: Relation, host: str) -> bool:
        return self.fetches(thing) and host == "cabinet_1"

    def switches(self, name: str, *, on: bool) -> bool:
        return False


def test_nothing_is_asked_for_that_the_robot_cannot_do(home: Scene) -> None:
    view, rooms = SceneView(home, Clumsy()), tuple(room.name for room in home.rooms)
    variant = Variant(home, rooms, tuple(item.name for item in home.objects if not item.fixed))
    goals = {
        category: {
            draft.task.goal_bddl
            for seed in range(40)
            if (draft := PlainWriter().write(variant, view, category, "t", np.random.default_rng(seed)))
        }
        for category in TaskCategory
    }
    assert goals[TaskCategory.PICK_AND_PLACE] == {"(inside mug_1 cabinet_1)", "(ontop mug_1 cabinet_1)"}
    assert goals[TaskCategory.APPLIANCE_USE]
    assert not any("toggled_on" in goal for goal in goals[TaskCategory.APPLIANCE_USE])
    assert not goals[TaskCategory.KITCHEN_OPERATION]


def test_a_survey_answers_alike_whatever_was_asked_before(home: Scene) -> None:
    names = ("apple_1", "stove_1")
    foresight = ReachabilitySurvey()
    with SceneSurvey(home, foresight) as at_once, SceneSurvey(home, foresight) as bit_by_bit:
        assert not bit_by_bit.bars([(Handling.PRESS, "stove_1")])
        assert not bit_by_bit.bars([(Handling.TAKE, "apple_1")])
        assert bit_by_bit.poses(names) == at_once.poses(names)
        assert set(bit_by_bit.poses(names[:1]).stands) == {"apple_1"}


@pytest.mark.parametrize(
    ("wish", "sentence"),
    [
        (RequestedAtom(predicate=Wanted.TOGGLED_ON, thing="stove_1"), "does not get at stove_1"),
        (RequestedAtom(predicate=Wanted.HOT, thing="apple_1"), "does not get at apple_1"),
        (RequestedAtom(predicate=Wanted.ONTOP, thing="mug_1", place="stove_1"), "can't bring mug_1 there"),
    ],
)
def test_a_model_is_told_what_the_robot_cannot_do(home: Scene, wish: RequestedAtom, sentence: str) -> None:
    request = TaskRequest(instruction="Please do this for me.", wishes=(wish,))
    with pytest.raises(ValueError, match=f"the robot tried, and {sentence}"):
        check_request(request, SceneView(home, Clumsy()), frozenset(home.by_name))
    check_request(request, SceneView(home), frozenset(home.by_name))
