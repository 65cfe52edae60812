"""Ball model of the robot's body agrees with Bullet, and the shoulder range is as specified."""

import itertools

import numpy as np
import pytest

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.robot import TUCKED_ARM, Posture, RobotBody
from embomatrix.sim.physical import arm, body
from embomatrix.sim.physical.grasp import facing
from embomatrix.sim.physical.reach import ArmReach, HeldGeometry, ToolPath
from embomatrix.sim.physical.rrt import path_between
from embomatrix.sim.physical.space import boxes_of
from embomatrix.sim.physical.stage import TOOL
from embomatrix.sim.robot_dimensions import LIFT_M, MAST_TOP_M, SHOULDER_LOW_M
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Pose

AHEAD, LEFT = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
FLOOR = (Pose((0.0, 0.0, -0.5)), (1e3, 1e3, 1.0), "floor")


def shoulder_heights(lift_m):
    posture = np.concatenate([[0.0, 0.0, 0.0, lift_m], np.array(TUCKED_ARM)])[None]
    turn, place = body.mounts(posture)
    return place[0, 2] + arm.SHOULDER_M * turn[0, 2, 2]


def test_hand_pose_agrees_with_bullet():
    rng = np.random.default_rng(0)
    pool = ClientPool()
    client = pool.take()
    try:
        for _ in range(5):
            place, lift = rng.uniform(-1.0, 1.0, 3), rng.uniform(0.0, LIFT_M)
            row = np.concatenate([place, [lift], rng.uniform(arm.LOW_RAD, arm.HIGH_RAD)])
            seen = RobotBody(client, Posture.of(row.tolist())).hand_pose() @ TOOL
            rotation, position = body.tools(row[None])
            np.testing.assert_allclose(seen.position_m, position[0], atol=1e-5)
            np.testing.assert_allclose(seen.rotation, rotation[0], atol=1e-5)
    finally:
        pool.give_back(client)
        pool.close()


def test_shoulder_height_ranges_from_shin_to_above_head():
    assert shoulder_heights(0.0) == pytest.approx(SHOULDER_LOW_M) == 0.29
    assert shoulder_heights(LIFT_M) > 1.5


def test_folded_robot_passes_under_high_obstacles():
    posture = np.concatenate([[0.0, 0.0, 0.0, 0.0], np.array(TUCKED_ARM)])[None]
    assert (body.balls(posture)[0, :, 2] + body.RADII).max() < ROBOT.height_m
    trunk, radii = body.trunk_balls(posture)
    assert (trunk[0, :, 2] + radii).max() < ROBOT.height_m
    assert (np.linalg.norm(trunk[0, :, :2], axis=1) + radii).max() <= ROBOT.radius_m
    assert ROBOT.height_m > MAST_TOP_M


def test_arm_on_the_base_is_a_self_collision():
    down = np.array([[0.0, 0.0, 0.0, 0.0, -np.pi / 2, -1.6, 0.0, -0.4, 0.0, 2.6, 0.785]])
    up = down.copy()
    up[0, 5] = 1.6
    both = np.concatenate([down, up])
    assert body.self_collides(both, body.balls(both), body.RADII).tolist() == [True, False]


@pytest.mark.parametrize("height_m", [0.15, 0.3, 1.0, 1.7])
def test_hand_reaches_level_under_a_roof_at_any_height(height_m):
    board = (0.5, 0.8, 0.02)
    boards = [(Pose((0.25, 0.0, height_m + off)), board, "shelf") for off in (-0.12, 0.2)]
    boxes = boxes_of([FLOOR, *boards])
    positions = np.array([[-0.05, 0.0, height_m], [0.1, 0.0, height_m], [0.2, 0.0, height_m]])
    tracks = [
        ToolPath(np.tile(facing(course, roll, LEFT), (3, 1, 1)), positions, np.zeros(3, dtype=bool), 2)
        for course in (AHEAD, np.array([np.cos(0.3), 0.0, -np.sin(0.3)]))
        for roll in (0.0, np.pi / 2)
    ]
    bases = np.array([[-away, aside, 0.0] for away in (0.4, 0.5, 0.6, 0.7) for aside in (-0.2, 0.0, 0.2)])
    way = next(ArmReach(boxes, boxes).paths(tracks, [bases]), None)
    assert way is not None
    np.testing.assert_allclose(body.tools(way.postures)[1], positions, atol=1e-6)


def stops_at_a_wall(one, other):
    """Free space with a wall at x = 0 and a door above y = 1."""
    line = one + np.linspace(0.0, 1.0, 41)[1:, None] * (other - one)
    struck = (np.abs(line[:, 0]) < 0.1) & (line[:, 1] < 1.0)
    if not struck.any():
        return other
    first = int(struck.argmax())
    return line[first - 1] if first else one


def test_two_trees_meet_through_a_door():
    start, goal = np.array([-1.0, 0.0]), np.array([1.0, 0.0])
    draws = np.random.default_rng(0).uniform(-2.0, 2.0, (200, 2))
    way = path_between(start, goal, draws, np.full(2, 0.1), stops_at_a_wall)
    assert way is not None
    np.testing.assert_array_equal(way[[0, -1]], [start, goal])
    assert all(np.array_equal(stops_at_a_wall(*pair), pair[1]) for pair in itertools.pairwise(way))


def test_no_path_is_found_through_a_closed_wall():
    draws = np.random.default_rng(0).uniform((-2.0, -2.0), (2.0, 0.9), (50, 2))
    assert (
        path_between(np.array([-1.0, 0.0]), np.array([1.0, 0.0]), draws, np.full(2, 0.1), stops_at_a_wall)
        is None
    )


def test_bowl_with_contents_is_level_until_tilted():
    level = np.array([[0.0, 0.0, 0.0, 0.6, -0.24, -1.28, 1.58, -2.64, -2.08, 2.15, 0.78]])
    tilted = level.copy()
    tilted[0, 10] += 0.6
    up = body.tools(level)[0][0].T @ np.array([0.0, 0.0, 1.0])
    bowl = HeldGeometry(np.zeros((1, 3)), np.array([0.05]), up)
    assert bowl.is_level(np.concatenate([level, tilted])).tolist() == [True, False]
    assert HeldGeometry(bowl.centres, bowl.radii).is_level(tilted)[0]
