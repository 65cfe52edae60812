"""Assets as URDFs: Bullet loads from them what our own factory makes."""

import contextlib
import math

import pytest
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.bench.engine.urdf import roll_pitch_yaw
from embomatrix.bench.engine.user_world import UrdfFactory, UrdfFiles, UserWorld
from embomatrix.sim.bullet.bodies import BodyFactory
from embomatrix.sim.bullet.client import ClientPool, pybullet
from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.physical.actor import PhysicalActor
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle
from embomatrix.world.geometry import Pose

POSE = Pose((1.0, 2.0, 0.5), (0.0, 0.0, math.sin(0.4), math.cos(0.4)))
TURNED = (0.2, -0.3, 0.5, math.sqrt(1 - 0.04 - 0.09 - 0.25))


@pytest.fixture
def client():
    pool = ClientPool()
    yield pool.take()
    pool.close()


def bounds(client, body):
    """Box around a body with all its links."""
    links = range(-1, pybullet().getNumJoints(body, physicsClientId=client))
    boxes = [pybullet().getAABB(body, link, physicsClientId=client) for link in links]
    lows, highs = zip(*boxes, strict=True)
    return (*map(min, zip(*lows, strict=True)), *map(max, zip(*highs, strict=True)))


def assets():
    scene = kitchen_scene()
    return {item.asset_id: scene.asset_of(item.name) for item in scene.objects}


@pytest.mark.parametrize("asset", assets().values(), ids=list(assets()))
def test_a_urdf_takes_the_room_of_the_body_that_it_stands_for(client, tmp_path, asset):
    urdf = UrdfFactory(client, UrdfFiles(tmp_path))
    open_half = tuple(0.5 for _ in asset.joints)
    ours = BodyFactory(client)
    for mine, theirs in (
        (ours.rigid(asset, POSE, open_half, 1.0), urdf.rigid(asset, POSE, open_half, 1.0)),
        (ours.hinged(asset, POSE), urdf.hinged(asset, POSE)),
    ):
        assert bounds(client, theirs) == pytest.approx(bounds(client, mine), abs=0.03)
    for index, (_, joint) in zip(urdf.joint_indices(asset), asset.joints, strict=True):
        told = pybullet().getJointInfo(theirs, index, physicsClientId=client)
        assert (told[8], told[9]) == (min(0.0, joint.upper), max(0.0, joint.upper))


def test_angles_make_the_rotation_that_they_were_taken_from():
    again = pybullet().getQuaternionFromEuler(roll_pitch_yaw(TURNED))
    assert again == pytest.approx(TURNED)


def test_nothing_sleeps_in_the_world_of_a_user(tmp_path):
    scene = kitchen_scene()
    bundle = Bundle(scene, {task.task_id: task for task in kitchen_tasks(scene)})
    heights = []
    for world in (DynamicWorld(scene), UserWorld(scene, UrdfFiles(tmp_path))):
        with contextlib.closing(load_simulator(bundle, actor=PhysicalActor(bundle, world))) as simulator:
            simulator.reset(next(iter(bundle.tasks.values())), 0)
            world.bodies.put("apple_1", Pose((0.0, 0.0, 3.0)))
            world.bodies.sleep("apple_1")
            world.step(24)
            heights.append(world.bodies.pose("apple_1").position_m[2])
    assert heights[0] == pytest.approx(3.0)
    assert heights[1] < 2.99
