"""The dynamic world: a scene in which time passes, with the robot in it.

Movable things are dynamic bodies, furniture stands and its doors swing freely against a little friction. What rests is put
to sleep, which costs nearly nothing and keeps it where it is; what comes into contact with anything awake wakes up by
itself, and what loses its support is woken by name. The world is built anew for every rollout: so it depends on nothing
that was simulated before.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bullet.bodies import BodyFactory
from embomatrix.sim.bullet.client import ClientPool, pybullet
from embomatrix.sim.bullet.mini_world import GRAVITY_M_S2, ROLLING_FRICTION
from embomatrix.sim.bullet.robot import Posture, RobotBody
from embomatrix.sim.engine import FLOOR, WALL
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from embomatrix.world.geometry import Vec3
    from embomatrix.world.scene import Scene

STEP_S: Final = 1 / 240
FLOOR_HALF_M: Final = 200.0
HINGE_NM: Final = 0.4
RUNNER_N: Final = 2.0
"""Friction of doors and of drawers."""
MOVED_M: Final = 5e-4
TURNED: Final = 2e-3
"""Less than this is the solver's sagging, not motion."""
SLOW_M_S: Final = 0.01
SLOW_RAD_S: Final = 0.1
TIP_M: Final = 0.1122
"""From the hand's frame to the fingertips' end."""
GLIDE: Final = 2
ROLL: Final = 4
"""How many steps one step lasts where nothing is to be touched: while the arm moves, and while an empty robot drives."""
AWAY_M: Final = -50.0
"""Depth at which things that are not in the world are kept."""


class DynamicWorld:
    """One scene and the robot in one client that is stepped. Objects are called by their names."""

    def __init__(self, scene: Scene, pool: ClientPool | None = None) -> None:
        """Take a client; ``build`` fills it."""
        self._scene = scene
        self._bullet = pybullet()
        self._owns_pool = pool is None
        self._pool = pool or ClientPool()
        self._client = self._pool.take()
        self._factory = BodyFactory(self._client, self._bullet.URDF_ENABLE_SLEEPING)
        self._bodies: dict[str, int] = {}
        self._names: dict[int, str] = {}
        self._joints: dict[str, tuple[int, ...]] = {}
        self._known: dict[str, tuple[Vec3, tuple[float, ...]]] = {}
        self._movable = tuple(item.name for item in scene.objects if not item.fixed)
        self._jointed = tuple(item.name for item in scene.objects if item.fixed and item.joints)
        self._still: list[int] = []
        self._held = ""
        self._hooked = ("", -1)
        self.steps = 0
        """Steps of 1/240 s since the world was built."""

    def build(
        self, poses: Mapping[str, Pose], joints: Mapping[str, tuple[float, ...]], posture: Posture
    ) -> None:
        """Fill the client: objects at these poses and joint positions, asleep; those without a pose are out of the world."""
        bullet, client = self._bullet, self._client
        bullet.resetSimulation(physicsClientId=client)
        self._factory.forget_shapes()
        bullet.setGravity(0, 0, GRAVITY_M_S2, physicsClientId=client)
        floor = self._factory.floor(0.0, 0.0, FLOOR_HALF_M)
        walls = self._factory.walls(self._scene.walls)
        self._names = {floor: FLOOR} | dict.fromkeys(walls, WALL)
        self._still = [floor, *walls]
        self._held, self.steps = "", 0
        for number, item in enumerate(self._scene.objects):
            pose = poses.get(item.name, Pose((number * 3.0, 0.0, AWAY_M)))
            self._add(item.name, pose, joints[item.name])
        self.robot = RobotBody(client, posture)
        # What is put to sleep falls for one step, until its contacts are known.
        self.rest()
        self.step(1)
        self.rest()
        self._still_sleep()
        for name in (*self._movable, *self._jointed):
            self._known[name] = self._state(name)

    def step(self, steps: int) -> None:
        """Let time pass."""
        for _ in range(steps):
            self._bullet.stepSimulation(physicsClientId=self._client)
        self.steps += steps

    def go(self, posture: Posture, steps: int) -> None:
        """Let time pass while the motors pursue a posture."""
        self.robot.steer(posture)
        self.step(steps)

    def glide(self, posture: Posture, steps: int) -> None:
        """The same in longer steps, for where nothing is to be touched."""
        self._pursue_coarsely(posture, steps, GLIDE)

    def roll(self, posture: Posture, steps: int) -> None:
        """The same for a drive: longer steps yet with an empty hand, as the base alone is to move."""
        self._pursue_coarsely(posture, steps, GLIDE if self._held else ROLL)

    def _pursue_coarsely(self, posture: Posture, steps: int, each: int) -> None:
        """Let steps pass, so many at once."""
        bullet, client = self._bullet, self._client
        bullet.setTimeStep(each * STEP_S, physicsClientId=client)
        # A motor's force becomes an impulse by the length that a step has when it is steered.
        self.robot.steer(posture)
        for _ in range(0, steps, each):
            bullet.stepSimulation(physicsClientId=client)
        bullet.setTimeStep(STEP_S, physicsClientId=client)
        self.steps += steps

    def pose(self, name: str) -> Pose:
        """Pose of the object's asset frame."""
        position, quat = self._bullet.getBasePositionAndOrientation(
            self._bodies[name], physicsClientId=self._client
        )
        return Pose(tuple(position), tuple(quat))

    def joints(self, name: str) -> tuple[float, ...]:
        """Joint positions as shares of their travel, kept within 0..1."""
        asset = self._scene.asset_of(name)
        return tuple(
            min(1.0, max(0.0, self._angle(name, index) / joint.upper))
            for index, (_, joint) in zip(self._joints[name], asset.joints, strict=True)
        )

    def is_in(self, name: str) -> bool:
        """Whether the object is in the world, be it in the hand."""
        return self.pose(name).position_m[2] > AWAY_M / 2

    def put(self, name: str, pose: Pose) -> None:
        """Bring in an object that was out of the world, or take it out: what is cut becomes its pieces."""
        self._bullet.resetBasePositionAndOrientation(
            self._bodies[name], pose.position_m, pose.quat_xyzw, physicsClientId=self._client
        )
        self.wake((name,))

    def take_out(self, name: str) -> None:
        """Take an object out of the world."""
        self._bullet.resetBasePositionAndOrientation(
            self._bodies[name],
            (self._bodies[name] * 3.0, 0.0, AWAY_M),
            (0, 0, 0, 1),
            physicsClientId=self._client,
        )
        self._sleep(name)

    def disturbed(self) -> tuple[str, ...]:
        """Objects that moved, or whose joints did, since the last call, in scene order. What the hand holds is left out."""
        found = []
        for name in (*self._movable, *self._jointed):
            now = self._state(name)
            if name != self._held and _differ(now, self._known[name]):
                self._known[name] = now
                found.append(name)
        return tuple(found)

    def settle(self, limit: int, chunk: int = 12) -> bool:
        """Let time pass until nothing moves or ``limit`` steps are over; True when all is at rest. Then all sleep."""
        quiet = False
        for _ in range(limit // chunk):
            self.step(chunk)
            quiet = not any(self._moves(name) for name in self._movable)
            if quiet:
                break
        self.rest()
        return quiet

    def rest(self) -> None:
        """Put everything to sleep but the robot and what it holds."""
        for name in (*self._movable, *self._jointed):
            if name != self._held:
                self._sleep(name)

    def wake(self, names: Iterable[str]) -> None:
        """Wake objects whose support may have gone."""
        for name in names:
            self._bullet.changeDynamics(
                self._bodies[name],
                -1,
                activationState=self._bullet.ACTIVATION_STATE_WAKE_UP,
                physicsClientId=self._client,
            )

    def touched_by(self, held: str, ignore: frozenset[str]) -> str:
        """What an object touches but those in ``ignore``; "" for nothing."""
        contacts = self._bullet.getContactPoints(bodyA=self._bodies[held], physicsClientId=self._client)
        for contact in contacts:
            other = self._names.get(contact[2], "")
            if other and other not in ignore and contact[8] < 0.002:
                return other
        return ""

    def hindrance(self, ignore: frozenset[str] = frozenset()) -> str:
        """What the robot, or what it holds, presses against most at this step; "" for nothing."""
        bodies = [self.robot.body] + ([self._bodies[self._held]] if self._held else [])
        pressed: dict[str, float] = {}
        for body in bodies:
            for contact in self._bullet.getContactPoints(bodyA=body, physicsClientId=self._client):
                other = self._names.get(contact[2], "")
                if other and other != self._held and other not in ignore:
                    pressed[other] = pressed.get(other, 0.0) + contact[9]
        return max(pressed, key=lambda name: (pressed[name], name)) if pressed else ""

    def gap(self, name: str) -> float:
        """Distance between the hand and an object, infinite from 5 cm on."""
        return min(
            (
                contact[8]
                for tip in sorted(self.robot.tips)
                for contact in self._bullet.getClosestPoints(
                    self.robot.body, self._bodies[name], 0.05, linkIndexA=tip, physicsClientId=self._client
                )
            ),
            default=math.inf,
        )

    def grasp(self, name: str) -> None:
        """Hold an object as it is in the hand now."""
        body = self._bodies[name]
        self.wake((name,))
        self.robot.hold(body, -1, self.robot.hand_pose().inverse() @ self.pose(name))
        self.robot.collide(body, range(-1, self._count(name)), on=False)
        self._held = name

    def loosen(self) -> None:
        """Let go of what the hand holds. The hand passes through it until ``part_from``: fingers do not drag it along."""
        self.robot.let_go()
        if self._held:
            self.wake((self._held,))
            self._held = ""

    def part_from(self, name: str) -> None:
        """The hand has left an object that it held, and meets it again."""
        self.robot.collide(self._bodies[name], range(-1, self._count(name)), on=True)

    def hook(self, name: str, joint: int) -> None:
        """Hold the leaf that a joint of the object moves by the point that the hand is at."""
        link = self._joints[name][joint]
        tool = self.robot.hand_pose()
        point = tool.apply((0.0, 0.0, TIP_M))
        state = self._bullet.getLinkState(
            self._bodies[name], link, computeForwardKinematics=1, physicsClientId=self._client
        )
        self.wake((name,))
        in_link = Pose(tuple(state[4]), tuple(state[5])).inverse().apply(point)
        self.robot.hook(self._bodies[name], link, (0.0, 0.0, TIP_M), in_link)
        self.robot.brush(self._bodies[name], link, on=False)
        self._hooked = (name, link)

    def unhook(self) -> None:
        """Let go of a leaf. The hand passes through it until ``part``: fingers in it do not drag it along."""
        self.robot.let_go()

    def part(self) -> None:
        """The hand has left the leaf, and meets it again."""
        name, link = self._hooked
        self.robot.brush(self._bodies[name], link, on=True)

    def close(self) -> None:
        """Give the client back. The world can't be used afterwards."""
        self._pool.give_back(self._client)
        if self._owns_pool:
            self._pool.close()

    def _add(self, name: str, pose: Pose, joints: tuple[float, ...]) -> None:
        item, asset = self._scene.by_name[name], self._scene.asset_of(name)
        if not item.fixed:
            body = self._factory.rigid(asset, pose, joints, asset.mass_kg)
            self._friction(body)
        elif asset.joints:
            body = self._factory.hinged(asset, pose)
            self._joints[name] = self._factory.joint_indices(asset)
            self._swing(body, name, joints)
        else:
            (body,) = self._factory.jointed(asset, [pose])
            self._bullet.resetBasePositionAndOrientation(
                body, pose.position_m, pose.quat_xyzw, physicsClientId=self._client
            )
            self._still.append(body)
        self._bodies[name], self._names[body] = body, name

    def _friction(self, body: int) -> None:
        self._bullet.changeDynamics(
            body,
            -1,
            rollingFriction=ROLLING_FRICTION,
            spinningFriction=ROLLING_FRICTION,
            physicsClientId=self._client,
        )

    def _swing(self, body: int, name: str, joints: tuple[float, ...]) -> None:
        """Give the joints their limits and friction, and set them."""
        bullet, client = self._bullet, self._client
        asset = self._scene.asset_of(name)
        for index, (_, joint), fraction in zip(self._joints[name], asset.joints, joints, strict=True):
            low, high = min(0.0, joint.upper), max(0.0, joint.upper)
            bullet.changeDynamics(
                body, index, jointLowerLimit=low, jointUpperLimit=high, physicsClientId=client
            )
            bullet.resetJointState(body, index, fraction * joint.upper, physicsClientId=client)
            force = HINGE_NM if joint.kind == "revolute" else RUNNER_N
            bullet.setJointMotorControl2(
                body, index, bullet.VELOCITY_CONTROL, targetVelocity=0, force=force, physicsClientId=client
            )

    def _count(self, name: str) -> int:
        return int(self._bullet.getNumJoints(self._bodies[name], physicsClientId=self._client))

    def _angle(self, name: str, index: int) -> float:
        return float(self._bullet.getJointState(self._bodies[name], index, physicsClientId=self._client)[0])

    def _state(self, name: str) -> tuple[Vec3, tuple[float, ...]]:
        if name in self._joints:
            return (0.0, 0.0, 0.0), tuple(self._angle(name, index) for index in self._joints[name])
        pose = self.pose(name)
        return pose.position_m, pose.quat_xyzw

    def _moves(self, name: str) -> bool:
        if name == self._held:
            return False
        linear, angular = self._bullet.getBaseVelocity(self._bodies[name], physicsClientId=self._client)
        return math.hypot(*linear) > SLOW_M_S or math.hypot(*angular) > SLOW_RAD_S

    def _still_sleep(self) -> None:
        """Put to sleep what never moves: else Bullet compares it in every step with all that lies on it, asleep or not."""
        bullet = self._bullet
        asleep = bullet.ACTIVATION_STATE_ENABLE_SLEEPING | bullet.ACTIVATION_STATE_SLEEP
        for body in self._still:
            bullet.changeDynamics(body, -1, activationState=asleep, physicsClientId=self._client)

    def _sleep(self, name: str) -> None:
        bullet, client, body = self._bullet, self._client, self._bodies[name]
        if name in self._joints:
            for index in self._joints[name]:
                bullet.resetJointState(body, index, self._angle(name, index), physicsClientId=client)
        else:
            bullet.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0), physicsClientId=client)
        bullet.changeDynamics(body, -1, activationState=bullet.ACTIVATION_STATE_SLEEP, physicsClientId=client)


def _differ(now: tuple[Vec3, tuple[float, ...]], before: tuple[Vec3, tuple[float, ...]]) -> bool:
    turned = max((abs(a - b) for a, b in zip(now[1], before[1], strict=True)), default=0.0)
    return math.dist(now[0], before[0]) > MOVED_M or turned > TURNED
