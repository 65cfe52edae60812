"""Pressing: only the hand touches the pressed object."""

import contextlib
import itertools

import numpy as np
import pytest
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.live_world import LiveWorld
from embomatrix.sim.physical import body
from embomatrix.sim.physical.fold import PATHS_TRIED
from embomatrix.sim.physical.press import press, press_paths
from embomatrix.sim.physical.space import collides
from embomatrix.sim.physical.stage import PhysicalStage
from embomatrix.sim.placing.pose_cache import standing_poses
from embomatrix.world.bundle import Bundle
from embomatrix.world.poses import PoseCache

PRESSED = ("microwave_1", "stove_1", "table_lamp_1")


@pytest.fixture(scope="module")
def stage():
    scene = kitchen_scene()
    with contextlib.closing(BulletEngine(scene)) as engine:
        poses = PoseCache({}, standing_poses(engine, PRESSED))
        world = LiveWorld(Bundle(scene, {}, poses), engine)
        with contextlib.closing(DynamicWorld(scene)) as dynamic:
            found = PhysicalStage(world, dynamic, lambda: None)
            found.begin()
            yield found


@pytest.mark.parametrize("name", PRESSED)
def test_press_paths_keep_the_arm_out_of_the_pressed_object(stage, name):
    boxes = stage.boxes_within(np.full(3, -9.0), np.full(3, 20.0))
    own = boxes.only(name)
    for stand in stage.world.navigator.stands(name, stage.world.navigator.start)[:4]:
        stage.stand_at(stand)
        ways = list(itertools.islice(press_paths(stage, name)[1], PATHS_TRIED))
        assert ways
        arms = body.balls(np.concatenate([way.postures for way in ways]))[:, ~body.HAND_BALLS]
        assert not collides(own, arms, body.RADII[~body.HAND_BALLS], 0.0).any()


@pytest.mark.parametrize("name", PRESSED)
def test_switch_is_pressed_from_the_first_standing_pose(stage, name):
    stage.world.robot = stage.world.navigator.stands(name, stage.world.navigator.start)[0]
    stage.begin()
    assert press(stage, name) is None
