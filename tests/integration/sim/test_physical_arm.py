"""Closed-form inverse kinematics of the arm agree with forward kinematics."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from tests.fakes import furniture as make
from tests.fakes.scenes import kitchen_scene, placed, scene_of, upright

from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.bullet.robot import tucked
from embomatrix.sim.floor.navigation import Navigator
from embomatrix.sim.physical import arm, body
from embomatrix.sim.physical.doors import DoorPanel
from embomatrix.sim.physical.floor import Floor
from embomatrix.sim.physical.grasp import cross
from embomatrix.sim.physical.motion import Mover
from embomatrix.sim.physical.space import boxes_of, collides, deepest_box
from embomatrix.sim.state.relations import Relations
from embomatrix.world.asset import Joint, JointKind, Link
from embomatrix.world.geometry import Aabb, ConvexPart, Pose, Shape
from embomatrix.world.poses import StandPose

SHARES = arrays.arrays(np.float64, (5, arm.JOINTS), elements=st.floats(0.02, 0.98))


@given(SHARES)
def test_every_solution_reaches_the_requested_tool_pose(shares):
    joints = arm.LOW_RAD + shares * (arm.HIGH_RAD - arm.LOW_RAD)
    rotation, position = arm.frames(joints)
    found = arm.solve(rotation[:, 7], position[:, 7], joints[:, 6])
    for branch in range(arm.BRANCHES):
        solved = ~np.isnan(found[:, branch, 0])
        again, there = arm.frames(found[solved, branch])
        np.testing.assert_allclose(there[:, 7], position[solved, 7], atol=1e-6)
        np.testing.assert_allclose(again[:, 7], rotation[solved, 7], atol=1e-6)


def test_nearly_all_postures_are_recovered_by_inverse_kinematics():
    rng = np.random.default_rng(0)
    joints = rng.uniform(arm.LOW_RAD, arm.HIGH_RAD, (500, arm.JOINTS))
    rotation, position = arm.frames(joints)
    found = arm.solve(rotation[:, 7], position[:, 7], joints[:, 6])
    assert (~np.isnan(found[:, :, 0])).any(axis=1).mean() > 0.97


def test_pose_out_of_reach_has_no_solution():
    found = arm.solve(np.eye(3)[None], np.array([[1.5, 0.0, 0.5]]), np.array([0.785]))
    assert np.isnan(found).all()


def test_tool_moves_with_base_lift_and_heading():
    rest = np.array([[0.0, 0.0, 0.0, 0.2, 0.0, -0.6, 0.0, -2.2, 0.0, 1.7, 0.785]])
    moved = rest.copy()
    moved[0, :4] = (1.0, 2.0, np.pi / 2, 0.5)
    (turn, place), (turned, there) = body.tools(rest), body.tools(moved)
    x, y, z = place[0]
    np.testing.assert_allclose(there[0], (1.0 - y, 2.0 + x, z + 0.3), atol=1e-9)
    np.testing.assert_allclose(turned[0], arm.about_z(np.array([np.pi / 2]))[0] @ turn[0], atol=1e-9)


def test_folded_arm_stays_within_the_robots_disc_and_clear_of_its_trunk():
    from embomatrix.sim.bullet.robot import TUCKED_ARM
    from embomatrix.skills.limits import ROBOT

    posture = np.concatenate([[0.0, 0.0, 0.0, 0.0], np.array(TUCKED_ARM)])[None]
    wide = np.linalg.norm(body.balls(posture)[0, :, :2], axis=1) + body.RADII
    assert wide.max() <= ROBOT.radius_m + 0.005
    assert not body.self_collides(posture, body.balls(posture), body.RADII)[0]


def test_balls_collide_with_a_rotated_box_only_inside_it():
    quarter = Pose.from_xyz_yaw(1.0, 0.0, 0.0, np.pi / 4)
    boxes = boxes_of([(quarter, (0.2, 2.0, 0.2), "beam")])
    balls = np.array([[[0.5, 0.5, 0.0]], [[1.5, 0.5, 0.0]]])  # the beam runs along (-1, 1)
    assert [deepest_box(boxes, row, np.array([0.05]), 0.0) for row in balls] == [0, -1]
    np.testing.assert_allclose(boxes.gaps(balls[:, 0])[:, 0], (-0.1, 0.6071), atol=1e-3)


@pytest.mark.parametrize("seed", range(8))
def test_fast_collision_check_agrees_with_the_exact_one(seed):
    rng = np.random.default_rng(seed)
    postures = np.zeros((int(rng.integers(1, 60)), body.NUMBERS))
    postures[:, body.ARM] = rng.uniform(arm.LOW_RAD, arm.HIGH_RAD, (len(postures), arm.JOINTS))
    places = rng.uniform(
        (-1.5, -1.5, 0.0, -3.0), (1.5, 1.5, 2.0, 3.0), (int(rng.integers(1, 40)), 4)
    ).tolist()
    boxes = boxes_of(
        [(Pose.from_xyz_yaw(*place), tuple(rng.uniform(0.05, 0.4, 3).tolist()), "box") for place in places]
    )
    balls = body.balls(postures)
    for margin_m in (-0.003, 0.0, 0.012):
        expected = np.array([deepest_box(boxes, row, body.RADII, margin_m) >= 0 for row in balls])
        np.testing.assert_array_equal(collides(boxes, balls, body.RADII, margin_m), expected)


def test_door_panel_box_moves_from_the_front_to_before_it():
    front = ConvexPart(Shape.BOX, Pose((0.31, 0.0, 0.0)), (0.02, 0.6, 1.0))
    hinge = Joint(JointKind.REVOLUTE, (0.31, -0.3, 0.0), (0.0, 0.0, 1.0), -np.pi / 2)
    link = Link("door", (front,), hinge)
    fridge = make.asset("fridge", "electric_refrigerator.n.01", (0.6, 0.6, 1.0), [], links=[link])
    around = Aabb.around([front.aabb(Pose((0.0, 0.0, 0.0)))])
    panel = DoorPanel("fridge_1", 0, link, hinge, fridge, Pose((1.0, 2.0, 0.5)), around)
    shut, opened = panel.at(0.0), panel.at(1.0)
    np.testing.assert_allclose((shut.low_m[0], shut.high_m[0]), (1.3, 1.32), atol=1e-9)
    np.testing.assert_allclose((opened.low_m[0], opened.high_m[0]), (1.31, 1.91), atol=0.02)


def test_touched_boxes_shrink_until_clear_and_others_stay():
    near, far = Pose((1.0, 0.0, 0.0)), Pose((0.0, 2.0, 0.0))
    boxes = boxes_of([(near, (0.2, 2.0, 0.2), "door"), (far, (0.2, 0.2, 0.2), "wall")])
    ball, radius = np.array([[0.88, 0.0, 0.0]]), np.array([0.05])  # 3 cm deep in the door
    assert deepest_box(boxes, ball, radius, 0.0) == 0
    freed = boxes.shrunk_clear_of(ball, radius, 0.012)
    np.testing.assert_allclose(freed.gaps(ball).min(axis=1) - radius, [0.012], atol=1e-9)
    np.testing.assert_array_equal(freed.half[1], boxes.half[1])


@pytest.mark.parametrize(("panel_m", "order"), [(2.4, [3.3, 4.5]), (3.6, [4.5, 3.3])])
def test_places_that_an_open_panel_cuts_off_come_last(panel_m, order):
    engine = BulletEngine(kitchen_scene())
    try:
        # From the south wall: the long rectangle reaches the furniture in the north, with more floor east of it.
        panel = boxes_of([(Pose((4.0, panel_m / 2, 0.5)), (0.04, panel_m, 1.0), "door")])
        east, west = np.array([[4.5, 0.5, 0.0]]), np.array([[3.3, 2.6, 0.0]])
        found = Floor(Navigator(engine, Relations(engine))).with_cut_off_last([west, east], panel)
    finally:
        engine.close()
    assert [float(group[0, 0]) for group in found] == order


@given(arrays.arrays(np.float64, (2, 3), elements=st.floats(-10, 10)))
def test_cross_product_equals_that_of_numpy(vectors):
    np.testing.assert_allclose(cross(*vectors), np.cross(*vectors), atol=1e-9)


def test_coarse_and_fine_motions_end_at_the_same_posture():
    scene = kitchen_scene()
    poses = {item.name: item.pose_world_asset for item in scene.objects}
    joints = {
        item.name: item.joints or (0.0,) * len(scene.asset_of(item.name).joints) for item in scene.objects
    }
    world = DynamicWorld(scene)
    ends = []
    for sweeps in (False, True):
        world.build(poses, joints, tucked(StandPose(scene.robot.x_m, scene.robot.y_m, scene.robot.yaw)))
        mover = Mover(world, lambda: None)
        goal = mover.posture + np.array([0.1, -0.1, 1.0, 0.2, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3])
        hit = mover.sweep(goal[None]) if sweeps else mover.follow(goal[None])
        assert hit is None
        ends.append(mover.posture)
    world.close()
    np.testing.assert_allclose(ends[1], ends[0], atol=0.01)


def test_stretched_arm_bears_its_weight_in_coarse_steps():
    scene = kitchen_scene()
    joints = {
        item.name: item.joints or (0.0,) * len(scene.asset_of(item.name).joints) for item in scene.objects
    }
    world = DynamicWorld(scene)
    world.build({}, joints, tucked(StandPose(scene.robot.x_m, scene.robot.y_m, 0.0)))
    mover = Mover(world, lambda: None)
    stretched = mover.posture
    stretched[body.LIFT], stretched[body.ARM] = 0.5, (0.0, 1.5, 0.0, -0.2, 0.0, 1.8, 0.785)
    assert mover.sweep(stretched[None]) is None
    assert np.abs(mover.posture - stretched).max() < 0.02
    world.close()


def test_lift_bears_its_load_beside_a_closely_fitting_panel():
    """Bullet divides by the effect of a contact. An immovable contact once stopped the solver for the robot too."""
    front, tall = ConvexPart(Shape.BOX, Pose((0.31, 0.0, 0.0)), (0.02, 0.6, 1.0)), (0.6, 0.6, 1.0)
    door = Link("door", (front,), Joint(JointKind.REVOLUTE, (0.31, 0.0, -0.5), (0.0, 1.0, 0.0), 1.5))
    oven = make.asset("oven", "oven.n.01", tall, [make.box((0.0, 0.0, 0.0), tall)], links=[door])
    side = make.block("countertop", "countertop.n.01", (0.7, 0.6, 1.0), {})
    row = [
        (placed(name, kind, "kitchen_0", upright(1.5, 2.0 + y, 0.01, kind), fixed=True), kind)
        for name, kind, y in (("oven_1", oven, 0.0), ("side_1", side, 0.59995), ("side_2", side, -0.59995))
    ]
    row[0] = replace(row[0][0], joints=(0.0,)), oven
    scene = scene_of("flush", row)
    world = DynamicWorld(scene)
    poses = {item.name: item.pose_world_asset for item in scene.objects}
    world.build(poses, {item.name: item.joints for item in scene.objects}, tucked(StandPose(2.16, 1.6, 0.0)))
    mover = Mover(world, lambda: None)
    assert mover.sweep(mover.posture + np.eye(body.NUMBERS)[1:2] * 0.8) is None
    assert mover.posture[body.LIFT] > -0.005
    world.close()
