"""Films interpolate between states; stages show them."""

import itertools
import math

import numpy as np
import pytest
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.camera import furnish_cutaway, render_egocentric, shoot_oblique
from embomatrix.sim.bullet.visual_scene import VisualScene
from embomatrix.sim.film import DRIVE_M_S, FRAMES_PER_S, film_cached
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle
from embomatrix.world.poses import StandPose

PLAN = "move fridge_1; open fridge_1; move apple_1; pick_up apple_1; move fridge_1; place fridge_1 inside"


@pytest.fixture(scope="module")
def scene():
    return kitchen_scene()


@pytest.fixture(scope="module")
def film(scene):
    simulator = load_simulator(Bundle(scene, {}))
    task = task_over(scene)
    film = film_cached(simulator, task, plan_of(task, PLAN), 0)
    simulator.close()
    return film


def test_robot_respects_its_speed_limit_in_films(film) -> None:
    most = 1.5 * DRIVE_M_S / FRAMES_PER_S
    for before, after in itertools.pairwise(film.frames):
        moved = math.dist((before.robot.x_m, before.robot.y_m), (after.robot.x_m, after.robot.y_m))
        assert moved <= most


def test_carried_object_stays_before_the_robot(film) -> None:
    driven = [frame for frame in film.frames if frame.step == 5]
    assert len({frame.robot for frame in driven}) > 3
    for frame in driven:
        x, y, _ = frame.poses["apple_1"].position_m
        assert math.hypot(x - frame.robot.x_m, y - frame.robot.y_m) < 0.6


def test_door_opens_gradually(film) -> None:
    shares = [frame.joints.get("fridge_1", (0.0,))[0] for frame in film.frames]
    assert shares == sorted(shares)
    assert len(set(shares)) > 3
    assert shares[-1] == 1.0


def test_film_ends_in_the_final_state_of_the_plan(film, scene) -> None:
    simulator = load_simulator(Bundle(scene, {}))
    simulator.execute(film.task, film.plan, 0)
    assert film.frames[-1].poses["apple_1"] == simulator.world.engine.pose("apple_1")
    assert film.frames[-1].robot == simulator.world.robot
    simulator.close()


def test_failed_plan_is_filmed_up_to_its_failure(scene) -> None:
    simulator = load_simulator(Bundle(scene, {}))
    task = task_over(scene)
    film = film_cached(simulator, task, plan_of(task, "pick_up apple_2; move apple_2"), 0)
    simulator.close()
    assert [step.ok for step in film.steps] == [False]
    assert {frame.step for frame in film.frames} == {0, 1}


def test_moving_an_object_changes_the_picture_and_moving_it_back_restores_it(scene) -> None:
    with VisualScene(scene) as stage:
        furnish_cutaway(stage)
        before = shoot_oblique(stage, scene.rooms, 160, 120)
        stage.hide("breakfast_table_1")
        without = shoot_oblique(stage, scene.rooms, 160, 120)
        stage.put("breakfast_table_1", scene.by_name["breakfast_table_1"].pose_world_asset)
        again = shoot_oblique(stage, scene.rooms, 160, 120)
    assert (before != without).any()
    np.testing.assert_array_equal(before, again)


def test_robot_camera_view_changes_with_the_heading(scene) -> None:
    views = render_egocentric(scene, StandPose(3.5, 1.5, 0.0), width_px=80, height_px=60)
    assert views.shape == (4, 60, 80, 3)
    assert all(len(np.unique(view.reshape(-1, 3), axis=0)) > 4 for view in views[:2])
    turned = render_egocentric(scene, StandPose(3.5, 1.5, math.pi / 2), width_px=80, height_px=60)
    np.testing.assert_array_equal(turned[:3], views[1:])
    assert (views[0] != views[1]).any()
