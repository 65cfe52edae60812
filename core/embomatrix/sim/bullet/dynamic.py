"""The dynamic world: a scene in which time passes, with the robot in it.

Movable things are dynamic bodies, furniture stands and its doors swing freely against a little friction. What rests is put
to sleep, which costs nearly nothing and keeps it where it is; what comes into contact with anything awake wakes up by
itself, and what loses its support is woken by name. The world is built anew for every rollout: so it depends on nothing
that was simulated before.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bullet.client import ClientPool, near_contacts, pybullet
from embomatrix.sim.bullet.dynamic_bodies import DynamicBodies, differ
from embomatrix.sim.bullet.mini_world import GRAVITY_M_S2
from embomatrix.sim.bullet.passage import Passage
from embomatrix.sim.bullet.robot import Posture, RobotBody
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from embomatrix.sim.bullet.dynamic_bodies import BodyState
    from embomatrix.world.scene import Scene

STEP_S: Final = 1 / 240
TIP_M: Final = 0.1122
"""From the hand's frame to the fingertips' end."""
CONVERGED: Final = 1e-5
"""Square of the change of speed, in m/s or rad/s, below which the solver stops before its fifty rounds: 3 mm/s."""
GLIDE: Final = 2
ROLL: Final = 4
"""How many steps one step lasts where nothing is to be touched: with something in the hand, and with nothing."""


class DynamicWorld:
    """One scene and the robot in one client that is stepped. Objects are called by their names."""

    def __init__(self, scene: Scene, pool: ClientPool | None = None) -> None:
        """Take a client; ``build`` fills it."""
        self._bullet = pybullet()
        self._owns_pool = pool is None
        self._pool = pool or ClientPool()
        self._client = self._pool.take()
        self.bodies = DynamicBodies(scene, self._client)
        self._known: dict[str, BodyState] = {}
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
        bullet.setGravity(0, 0, GRAVITY_M_S2, physicsClientId=client)
        bullet.setPhysicsEngineParameter(solverResidualThreshold=CONVERGED, physicsClientId=client)
        self._held, self.steps = "", 0
        with near_contacts(client):
            self.bodies.fill(poses, joints)
            self.robot = RobotBody(client, posture)
        # What is put to sleep falls for one step, until its contacts are known.
        self.rest()
        self.step(1)
        self.rest()
        self.bodies.spare_idle_contacts()
        self.bodies.still_sleep()
        self._known = {name: self.bodies.state(name) for name in self.bodies.moving}

    def step(self, steps: int) -> None:
        """Let time pass."""
        with near_contacts(self._client):
            for _ in range(steps):
                self._bullet.stepSimulation(physicsClientId=self._client)
        self.steps += steps

    def go(self, posture: Posture, steps: int) -> None:
        """Let time pass while the motors pursue a posture."""
        self.robot.steer(posture)
        self.step(steps)

    def glide(self, posture: Posture, steps: int) -> None:
        """The same in longer steps, for where nothing is to be touched: longer yet with an empty hand."""
        each = GLIDE if self._held else ROLL
        bullet, client = self._bullet, self._client
        bullet.setTimeStep(each * STEP_S, physicsClientId=client)
        # A motor's force becomes an impulse by the length that a step has when it is steered.
        self.robot.steer(posture)
        with near_contacts(client):
            for _ in range(0, steps, each):
                bullet.stepSimulation(physicsClientId=client)
        bullet.setTimeStep(STEP_S, physicsClientId=client)
        self.steps += steps

    def passage(self) -> Passage | None:
        """A motion from where the robot is; None while anything moves of itself, as time must pass for that."""
        if self._stirs(self.bodies.moving):
            return None
        return Passage(self._client, self.robot, self.bodies, self._held)

    def disturbed(self) -> tuple[str, ...]:
        """Objects that moved, or whose joints did, since the last call, in scene order. What the hand holds is left out."""
        found = []
        for name in self.bodies.moving:
            now = self.bodies.state(name)
            if name != self._held and differ(now, self._known[name]):
                self._known[name] = now
                found.append(name)
        return tuple(found)

    def settle(self, limit: int, chunk: int = 12) -> bool:
        """Let time pass until nothing moves or ``limit`` steps are over; True when all is at rest. Then all sleep."""
        quiet = False
        for _ in range(limit // chunk):
            self.step(chunk)
            quiet = not self._stirs(self.bodies.movable)
            if quiet:
                break
        self.rest()
        return quiet

    def _stirs(self, names: Iterable[str]) -> bool:
        """Whether any of some objects is in motion but what the hand holds."""
        return any(name != self._held and self.bodies.is_in_motion(name) for name in names)

    def rest(self) -> None:
        """Put everything to sleep but the robot and what it holds."""
        for name in self.bodies.moving:
            if name != self._held:
                self.bodies.sleep(name)

    def touched_by(self, held: str, ignore: frozenset[str]) -> str:
        """What an object touches but those in ``ignore``; "" for nothing."""
        contacts = self._bullet.getContactPoints(bodyA=self.bodies.body(held), physicsClientId=self._client)
        for contact in contacts:
            other = self.bodies.name(contact[2])
            if other and other not in ignore and contact[8] < 0.002:
                return other
        return ""

    def hindrance(self, ignore: frozenset[str] = frozenset()) -> str:
        """What the robot, or what it holds, presses against most at this step; "" for nothing."""
        bodies = [self.robot.body] + ([self.bodies.body(self._held)] if self._held else [])
        pressed: dict[str, float] = {}
        for body in bodies:
            for contact in self._bullet.getContactPoints(bodyA=body, physicsClientId=self._client):
                other = self.bodies.name(contact[2])
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
                    self.robot.body,
                    self.bodies.body(name),
                    0.05,
                    linkIndexA=tip,
                    physicsClientId=self._client,
                )
            ),
            default=math.inf,
        )

    def grasp(self, name: str) -> None:
        """Hold an object as it is in the hand now."""
        body = self.bodies.body(name)
        self.bodies.wake((name,))
        self.robot.hold(body, -1, self.robot.hand_pose().inverse() @ self.bodies.pose(name))
        self.robot.collide(body, self.bodies.links(name), on=False)
        self._held = name

    def loosen(self) -> None:
        """Let go of what the hand holds. The hand passes through it until ``part_from``: fingers do not drag it along."""
        self.robot.let_go()
        if self._held:
            self.bodies.wake((self._held,))
            self._held = ""

    def part_from(self, name: str) -> None:
        """The hand has left an object that it held, and meets it again."""
        self.robot.collide(self.bodies.body(name), self.bodies.links(name), on=True)

    def hook(self, name: str, joint: int) -> None:
        """Hold the leaf that a joint of the object moves by the point that the hand is at."""
        link = self.bodies.leaf(name, joint)
        tool = self.robot.hand_pose()
        point = tool.apply((0.0, 0.0, TIP_M))
        state = self._bullet.getLinkState(
            self.bodies.body(name), link, computeForwardKinematics=1, physicsClientId=self._client
        )
        self.bodies.wake((name,))
        in_link = Pose(tuple(state[4]), tuple(state[5])).inverse().apply(point)
        self.robot.hook(self.bodies.body(name), link, (0.0, 0.0, TIP_M), in_link)
        self.robot.brush(self.bodies.body(name), link, on=False)
        self._hooked = (name, link)

    def unhook(self) -> None:
        """Let go of a leaf. The hand passes through it until ``part``: fingers in it do not drag it along."""
        self.robot.let_go()

    def part(self) -> None:
        """The hand has left the leaf, and meets it again."""
        name, link = self._hooked
        self.robot.brush(self.bodies.body(name), link, on=True)

    def close(self) -> None:
        """Give the client back. The world can't be used afterwards."""
        self._pool.give_back(self._client)
        if self._owns_pool:
            self._pool.close()
