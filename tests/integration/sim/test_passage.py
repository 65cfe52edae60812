"""Passages: free-space motions of the robot without simulation steps."""

import contextlib
import math

import numpy as np
import pytest
from tests.fakes import furniture as make
from tests.fakes.scenes import placed, scene_of, upright

from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.bullet.robot import Posture, tucked
from embomatrix.sim.physical import body
from embomatrix.sim.physical.motion import STEERED, Mover
from embomatrix.world.poses import StandPose

OUT = (0.5, 0.0, 1.5, 0.0, -0.2, 0.0, 1.8, 0.785)
"""Lift and arm of a robot that holds its hand far ahead."""


@contextlib.contextmanager
def room_with(*things):
    """Return a dynamic world with the robot and objects: names, sizes, centres of the undersides, and whether fixed."""
    rows = []
    for name, size, place, fixed in things:
        thing = make.block(name, "block.n.01", size, {})
        rows.append((placed(name, thing, "kitchen_0", upright(*place, thing), fixed=fixed), thing))
    scene = scene_of("room", rows)
    with contextlib.closing(DynamicWorld(scene)) as world:
        world.build(
            {item.name: item.pose_world_asset for item in scene.objects},
            {item.name: () for item in scene.objects},
            tucked(StandPose(2.0, 1.5, 0.0)),
        )
        yield world


FAR_OFF = ("box_1", (0.1, 0.1, 0.1), (3.5, 2.5, 0.0), False)
LOAD = ("load_1", (0.05, 0.05, 0.1), (2.6, 1.5, 0.7), False)


def test_free_drive_ends_exactly_at_its_target_in_the_stepped_time():
    with room_with(FAR_OFF) as world:
        ticks = []
        mover = Mover(world, lambda: ticks.append(world.steps))
        goal = mover.posture + np.array([0.5, -0.4, 1.0, *np.zeros(8)])
        before = world.steps
        assert mover.sweep(goal[None]) is None
        np.testing.assert_allclose(mover.posture, goal, atol=1e-6)
        assert world.steps - before > 0.5 * 240
        assert (world.steps - before) % STEERED == 0
        assert ticks == sorted(ticks)
        assert len(ticks) > 10


def test_robot_stays_at_the_end_of_a_passage_when_stepped():
    with room_with(FAR_OFF) as world:
        mover = Mover(world, lambda: None)
        goal = mover.posture
        goal[body.LIFT :] = OUT
        assert mover.sweep(goal[None]) is None
        mover.wait(48)
        assert np.abs(mover.posture - goal).max() < 0.02


@pytest.mark.parametrize(
    ("degrees", "back_m", "stops"),
    [(30.0, 0.08, True), (47.0, 0.08, True), (11.0, 0.02, False), (47.0, 0.02, False)],
)
def test_thin_obstacle_is_detected(degrees, back_m, stops):
    """A rod stops the hand. Compliant fingers may pass it, as physics decides; the sweep's end is then inexact."""
    turn = np.eye(body.NUMBERS)[body.YAW] * math.radians(degrees)
    start = np.array([2.0, 1.5, 0.0, *OUT])
    rotation, position = body.tools((start + turn)[None])
    x, y, _ = (position[0] - back_m * rotation[0, :, 2]).tolist()
    with room_with(("rod_1", (0.01, 0.01, 1.6), (x, y, 0.0), True)) as world:
        world.robot.appear(Posture.of(start.tolist()))
        mover = Mover(world, lambda: None)
        hit = mover.sweep((start + 2 * turn)[None])
        assert hit == "rod_1" or not stops
        assert np.abs(mover.posture - (start + 2 * turn)).max() > 1e-7


def test_clearance_check_restores_robot_and_load():
    with room_with(LOAD) as world:
        world.grasp("load_1")
        before, load = world.robot.posture, world.bodies.pose("load_1")
        passage = world.passage()
        assert passage is not None
        ahead = np.array(before.numbers) + np.array([0.3, *np.zeros(10)])
        assert passage.is_clear([Posture.of(ahead.tolist())])
        np.testing.assert_allclose(world.robot.posture.numbers, before.numbers, atol=1e-6)
        np.testing.assert_allclose(world.bodies.pose("load_1").position_m, load.position_m, atol=1e-6)


def test_held_object_keeps_its_pose_in_the_hand():
    with room_with(LOAD) as world:
        world.grasp("load_1")
        held = world.robot.hand_pose().inverse() @ world.bodies.pose("load_1")
        mover = Mover(world, lambda: None)
        goal = mover.posture + np.array([0.2, 0.2, 1.2, *np.zeros(8)])
        assert mover.sweep(goal[None]) is None
        now = world.robot.hand_pose().inverse() @ world.bodies.pose("load_1")
        np.testing.assert_allclose(now.position_m, held.position_m, atol=1e-6)
        np.testing.assert_allclose(mover.posture, goal, atol=1e-6)


def test_collision_of_the_held_object_is_detected():
    post = ("post_1", (0.01, 0.01, 1.6), (3.0, 1.5, 0.0), True)
    for things, passes in (((post,), True), ((LOAD, post), False)):
        with room_with(*things) as world:
            if LOAD in things:
                world.grasp("load_1")
            rows = np.array(world.robot.posture.numbers) + np.linspace(0.0, 0.5, 26)[:, None] * np.eye(11)[:1]
            passage = world.passage()
            assert passage is not None
            assert passage.is_clear([Posture.of(row) for row in rows.tolist()]) is passes


def test_no_passage_while_an_object_falls():
    with room_with(("load_1", (0.1, 0.1, 0.1), (3.5, 2.5, 1.5), False)) as world:
        world.bodies.wake(["load_1"])
        world.step(12)
        assert world.passage() is None
        mover = Mover(world, lambda: None)
        assert mover.sweep(mover.posture[None] + np.array([0.5, *np.zeros(10)])) is None
        assert world.bodies.pose("load_1").position_m[2] < 1.0
