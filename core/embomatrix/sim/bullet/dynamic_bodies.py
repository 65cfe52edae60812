"""Bodies of a stepped scene, addressed by object name: placed, moved, put to sleep and woken."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from embomatrix.sim.bullet.bodies import BodyFactory
from embomatrix.sim.bullet.client import BulletClient
from embomatrix.sim.engine import BACKGROUND, FLOOR, WALL
from embomatrix.world.asset import JointKind
from embomatrix.world.geometry import Pose, Vec3
from embomatrix.world.scene import Scene

BodyState = tuple[Vec3, tuple[float, ...]]
"""Position and quaternion of what is movable; zeros and the joints' positions of furniture."""

FLOOR_HALF_M: Final = 200.0
HINGE_NM: Final = 0.4
RUNNER_N: Final = 2.0
"""Friction of hinged doors and of drawers."""
CLOSER_NM: Final = 4.0
CLOSER_N: Final = 20.0
"""Strength with which a panel swings, or slides, back after a failed attempt to move it."""
BACK_PER_S: Final = 1.5
"""Speed of such a panel, in rad/s or m/s."""
SLOW_M_S: Final = 0.01
SLOW_RAD_S: Final = 0.1
MOVED_M: Final = 5e-4
TURNED: Final = 2e-3
"""Smallest motion; less is sagging of the solver."""
ALONG: Final = 0.999
"""Cosine above which two directions count as parallel."""
AWAY_M: Final = -50.0
"""Depth at which objects outside the world are kept."""


class DynamicBodies:
    """Bodies of one scene in one client."""

    def __init__(self, scene: Scene, client: BulletClient) -> None:
        """``fill`` makes the bodies."""
        self._scene = scene
        self._bullet = client
        self._factory = BodyFactory(client, self._bullet.URDF_ENABLE_SLEEPING)
        self._bodies: dict[str, int] = {}
        self._names: dict[int, str] = {}
        self._joints: dict[str, tuple[int, ...]] = {}
        self._still: list[int] = []
        self.movable = tuple(item.name for item in scene.objects if not item.fixed)
        self.moving = (*self.movable, *(item.name for item in scene.objects if item.fixed and item.joints))
        """Movable objects, then furniture with joints."""

    def fill(self, poses: Mapping[str, Pose], joints: Mapping[str, tuple[float, ...]]) -> None:
        """Fill an empty client.

        Floor, walls, background, and objects at these poses and joint positions; objects without a pose stay outside.
        """
        self._factory.forget_shapes()
        floor = self._factory.floor(0.0, 0.0, FLOOR_HALF_M)
        walls = self._factory.statics(self._scene.walls)
        background = self._factory.statics(self._scene.background_parts)
        self._names = {floor: FLOOR} | dict.fromkeys(walls, WALL) | dict.fromkeys(background, BACKGROUND)
        self._still = [floor, *walls, *background]
        for number, item in enumerate(self._scene.objects):
            pose = poses.get(item.name, Pose((number * 3.0, 0.0, AWAY_M)))
            self._add(item.name, pose, joints[item.name])

    def body(self, name: str) -> int:
        """Body id of an object."""
        return self._bodies[name]

    def links(self, name: str) -> range:
        """Link numbers of a body, its base first."""
        return range(-1, int(self._bullet.getNumJoints(self._bodies[name])))

    def panel_link(self, name: str, joint: int) -> int:
        """Link that a joint of an object moves."""
        return self._joints[name][joint]

    def name(self, body: int) -> str:
        """Name of a body; "" for one outside the scene."""
        return self._names.get(body, "")

    def pose(self, name: str) -> Pose:
        """Pose of the object's asset frame."""
        position, quat = self._bullet.getBasePositionAndOrientation(self._bodies[name])
        return Pose(tuple(position), tuple(quat))

    def joints(self, name: str) -> tuple[float, ...]:
        """Joint positions as shares of their travel, kept within 0..1."""
        asset = self._scene.asset_of(name)
        return tuple(
            min(1.0, max(0.0, self._angle(name, index) / joint.upper))
            for index, (_, joint) in zip(self._joints[name], asset.joints, strict=True)
        )

    def has_panels(self, name: str) -> bool:
        """Return True if an object's joints move. A portable object, such as a laptop, is one rigid body."""
        return name in self._joints

    def is_in(self, name: str) -> bool:
        """Return True if the object is in the world, also in the hand."""
        return self.pose(name).position_m[2] > AWAY_M / 2

    def swing_back(self, name: str, fractions: Sequence[float]) -> None:
        """Pull the panels of an object to shares of their travel while time passes, until ``brake``."""
        self.wake((name,))
        asset = self._scene.asset_of(name)
        for index, (_, joint), fraction in zip(self._joints[name], asset.joints, fractions, strict=True):
            self._bullet.setJointMotorControl2(
                self._bodies[name],
                index,
                self._bullet.POSITION_CONTROL,
                targetPosition=fraction * joint.upper,
                maxVelocity=BACK_PER_S,
                force=CLOSER_NM if joint.kind is JointKind.REVOLUTE else CLOSER_N,
            )

    def brake(self, name: str) -> None:
        """Leave the panels of an object to their friction."""
        asset = self._scene.asset_of(name)
        for index, (_, joint) in zip(self._joints[name], asset.joints, strict=True):
            self._bullet.setJointMotorControl2(
                self._bodies[name],
                index,
                self._bullet.VELOCITY_CONTROL,
                targetVelocity=0,
                force=HINGE_NM if joint.kind is JointKind.REVOLUTE else RUNNER_N,
            )

    def put(self, name: str, pose: Pose) -> None:
        """Bring in an object from outside the world, such as the piece of a sliced one."""
        self._bullet.resetBasePositionAndOrientation(self._bodies[name], pose.position_m, pose.quat_xyzw)
        self.wake((name,))

    def take_out(self, name: str) -> None:
        """Take an object out of the world."""
        self._bullet.resetBasePositionAndOrientation(
            self._bodies[name], (self._bodies[name] * 3.0, 0.0, AWAY_M), (0, 0, 0, 1)
        )
        self.sleep(name)

    def wake(self, names: Iterable[str]) -> None:
        """Wake objects whose support may be gone."""
        for name in names:
            self._bullet.changeDynamics(
                self._bodies[name], -1, activationState=self._bullet.ACTIVATION_STATE_WAKE_UP
            )

    def state(self, name: str) -> BodyState:
        """State of a movable object or of furniture with joints."""
        if name in self._joints:
            return (0.0, 0.0, 0.0), tuple(self._angle(name, index) for index in self._joints[name])
        pose = self.pose(name)
        return pose.position_m, pose.quat_xyzw

    def is_in_motion(self, name: str) -> bool:
        """Return True if an object, or any of its panels, moves faster than a resting one."""
        bullet, body = self._bullet, self._bodies[name]
        if name in self._joints:
            states = bullet.getJointStates(body, self._joints[name])
            return any(abs(state[1]) > SLOW_M_S for state in states)
        linear, angular = bullet.getBaseVelocity(body)
        return math.hypot(*linear) > SLOW_M_S or math.hypot(*angular) > SLOW_RAD_S

    def still_sleep(self) -> None:
        """Put immovable bodies to sleep; otherwise Bullet compares them in every step with everything on them."""
        asleep = self._bullet.ACTIVATION_STATE_ENABLE_SLEEPING | self._bullet.ACTIVATION_STATE_SLEEP
        for body in self._still:
            self._bullet.changeDynamics(body, -1, activationState=asleep)

    def spare_idle_contacts(self) -> None:
        """Disable contacts between panels and touching bodies if neither can push the other.

        A force along a hinge, or across runners, moves no panel. Bullet divides by the mobility along the force: such a
        contact stops the solver after one iteration, also for a robot that comes near, and its lift sinks.
        """
        for name in self._joints:
            body = self._bodies[name]
            for contact in self._bullet.getContactPoints(bodyA=body):
                _, _, other, link, other_link, *_ = contact
                if not self._gives(body, link, contact[7]) and not self._gives(other, other_link, contact[7]):
                    self._bullet.setCollisionFilterPair(body, other, link, other_link, 0)

    def _gives(self, body: int, link: int, normal: Vec3) -> bool:
        """Return True if a force along a normal moves a link of a body. Bodies outside the scene, such as the robot, move."""
        name = self.name(body)
        if name not in self._joints:
            return not name or name in self.movable
        while link >= 0 and link not in self._joints[name]:
            link = int(self._bullet.getJointInfo(body, link)[16])
        if link < 0:
            return False
        _, joint = self._scene.asset_of(name).joints[self._joints[name].index(link)]
        along = abs(float(self.pose(name).rotation @ joint.axis @ normal))
        return along < ALONG if joint.kind is JointKind.REVOLUTE else along > 1.0 - ALONG

    def sleep(self, name: str) -> None:
        """Put an object to sleep in place."""
        bullet, body = self._bullet, self._bodies[name]
        if name in self._joints:
            for index in self._joints[name]:
                bullet.resetJointState(body, index, self._angle(name, index))
        else:
            bullet.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0))
        bullet.changeDynamics(body, -1, activationState=bullet.ACTIVATION_STATE_SLEEP)

    def _add(self, name: str, pose: Pose, joints: tuple[float, ...]) -> None:
        item, asset = self._scene.by_name[name], self._scene.asset_of(name)
        if not item.fixed:
            body = self._factory.rigid(asset, pose, joints, asset.mass_kg)
            self._factory.brake(body)
        elif asset.joints:
            body = self._factory.hinged(asset, pose)
            self._joints[name] = self._factory.joint_indices(asset)
            self._swing(body, name, joints)
            self._bodies[name] = body
            self.brake(name)
        else:
            (body,) = self._factory.jointed(asset, [pose])
            self._bullet.resetBasePositionAndOrientation(body, pose.position_m, pose.quat_xyzw)
            self._still.append(body)
        self._bodies[name], self._names[body] = body, name

    def _swing(self, body: int, name: str, joints: tuple[float, ...]) -> None:
        """Set limits and positions of the joints."""
        asset = self._scene.asset_of(name)
        for index, (_, joint), fraction in zip(self._joints[name], asset.joints, joints, strict=True):
            low, high = min(0.0, joint.upper), max(0.0, joint.upper)
            self._bullet.changeDynamics(body, index, jointLowerLimit=low, jointUpperLimit=high)
            self._bullet.resetJointState(body, index, fraction * joint.upper)

    def _angle(self, name: str, index: int) -> float:
        return float(self._bullet.getJointState(self._bodies[name], index)[0])


def differ(now: BodyState, before: BodyState) -> bool:
    """Return True if something moved between two states."""
    turned = max((abs(a - b) for a, b in zip(now[1], before[1], strict=True)), default=0.0)
    return math.dist(now[0], before[0]) > MOVED_M or turned > TURNED
