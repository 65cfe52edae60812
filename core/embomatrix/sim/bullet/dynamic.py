"""Dynamic world: a stepped scene with the robot in it.

Movable objects are dynamic bodies; furniture is fixed, and its doors swing against slight friction. Resting bodies sleep,
which costs almost nothing and keeps them in place. Contact with an awake body wakes them; a body that loses its support is
woken by name. The world is rebuilt for every rollout and so does not depend on earlier ones.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Final

from embomatrix.sim.bullet.client import connect, near_contacts
from embomatrix.sim.bullet.dynamic_bodies import BodyState, DynamicBodies, differ
from embomatrix.sim.bullet.mini_world import GRAVITY_M_S2
from embomatrix.sim.bullet.passage import Passage
from embomatrix.sim.bullet.robot import Posture, RobotBody
from embomatrix.world.geometry import Pose
from embomatrix.world.scene import Scene

STEP_S: Final = 1 / 240
TIP_M: Final = 0.1122
"""Distance from the hand's frame to the fingertips' end."""
CONVERGED: Final = 1e-5
"""Squared change of speed, in (m/s)^2 or (rad/s)^2, below which the solver stops before its 50 iterations: 3 mm/s."""
GLIDE: Final = 2
ROLL: Final = 4
"""Step length multipliers in free space: with an object in the hand (GLIDE) and with an empty hand (ROLL)."""


class DynamicWorld:
    """Scene and robot in one stepped client. Objects are addressed by name."""

    def __init__(self, scene: Scene) -> None:
        """Connect a client; ``build`` fills it."""
        self._bullet = connect()
        self.bodies = DynamicBodies(scene, self._bullet)
        self._known: dict[str, BodyState] = {}
        self._held = ""
        self._hooked = ("", -1)
        self.steps = 0
        """Steps of 1/240 s since the world was built."""

    def build(
        self, poses: Mapping[str, Pose], joints: Mapping[str, tuple[float, ...]], posture: Posture
    ) -> None:
        """Fill the client: objects asleep at these poses and joint positions; objects without a pose are outside the world."""
        self._bullet.resetSimulation()
        self._bullet.setGravity(0, 0, GRAVITY_M_S2)
        self._bullet.setPhysicsEngineParameter(solverResidualThreshold=CONVERGED)
        self._held, self.steps = "", 0
        with near_contacts(self._bullet):
            self.bodies.fill(poses, joints)
            self.robot = RobotBody(self._bullet, posture)
        # Sleeping bodies fall for one step until their contacts are known.
        self.rest()
        self.step(1)
        self.rest()
        self.bodies.spare_idle_contacts()
        self.bodies.still_sleep()
        self._known = {name: self.bodies.state(name) for name in self.bodies.moving}

    def step(self, steps: int) -> None:
        """Step the simulation."""
        with near_contacts(self._bullet):
            for _ in range(steps):
                self._bullet.stepSimulation()
        self.steps += steps

    def go(self, posture: Posture, steps: int) -> None:
        """Step while the motors drive towards a posture."""
        self.robot.steer(posture)
        self.step(steps)

    def glide(self, posture: Posture, steps: int) -> None:
        """Step in longer increments for free space: longest with an empty hand."""
        each = GLIDE if self._held else ROLL
        self._bullet.setTimeStep(each * STEP_S)
        # Bullet converts a motor's force to an impulse with the step length at the time of the command.
        self.robot.steer(posture)
        with near_contacts(self._bullet):
            for _ in range(0, steps, each):
                self._bullet.stepSimulation()
        self._bullet.setTimeStep(STEP_S)
        self.steps += steps

    def passage(self) -> Passage | None:
        """Free-space motion from the robot's posture; None while anything else moves, since time must pass for that."""
        if self._stirs(self.bodies.moving):
            return None
        return Passage(self._bullet, self.robot, self.bodies, self._held)

    def disturbed(self) -> tuple[str, ...]:
        """Objects that moved, or whose joints did, since the last call, in scene order; without the held object."""
        found = []
        for name in self.bodies.moving:
            now = self.bodies.state(name)
            if name != self._held and differ(now, self._known[name]):
                self._known[name] = now
                found.append(name)
        return tuple(found)

    def settle(self, limit: int, chunk: int = 12) -> bool:
        """Step until nothing moves or ``limit`` steps are over; then all sleep. Return True if all is at rest."""
        quiet = False
        for _ in range(limit // chunk):
            self.step(chunk)
            quiet = not self._stirs(self.bodies.movable)
            if quiet:
                break
        self.rest()
        return quiet

    def _stirs(self, names: Iterable[str]) -> bool:
        """Return True if any of these objects but the held one moves."""
        return any(name != self._held and self.bodies.is_in_motion(name) for name in names)

    def rest(self) -> None:
        """Put everything but the robot and the held object to sleep."""
        for name in self.bodies.moving:
            if name != self._held:
                self.bodies.sleep(name)

    def touched_by(self, held: str, ignore: frozenset[str]) -> str:
        """Body in contact with an object, apart from those in ``ignore``; "" for none."""
        contacts = self._bullet.getContactPoints(bodyA=self.bodies.body(held))
        for contact in contacts:
            other = self.bodies.name(contact[2])
            if other and other not in ignore and contact[8] < 0.002:
                return other
        return ""

    def hindrance(self) -> str:
        """Body that the robot or its held object presses against most in this step; "" for none."""
        bodies = [self.robot.body] + ([self.bodies.body(self._held)] if self._held else [])
        pressed: dict[str, float] = {}
        for body in bodies:
            for contact in self._bullet.getContactPoints(bodyA=body):
                other = self.bodies.name(contact[2])
                if other and other != self._held:
                    pressed[other] = pressed.get(other, 0.0) + contact[9]
        return max(pressed, key=lambda name: (pressed[name], name)) if pressed else ""

    def gap(self, name: str) -> float:
        """Distance between the hand and an object; infinite beyond 5 cm."""
        return min(
            (
                contact[8]
                for tip in sorted(self.robot.tips)
                for contact in self._bullet.getClosestPoints(
                    self.robot.body, self.bodies.body(name), 0.05, linkIndexA=tip
                )
            ),
            default=math.inf,
        )

    def grasp(self, name: str) -> None:
        """Attach an object to the hand at its current pose."""
        body = self.bodies.body(name)
        self.bodies.wake((name,))
        self.robot.hold(body, -1, self.robot.hand_pose().inverse() @ self.bodies.pose(name))
        self.robot.collide(body, self.bodies.links(name), on=False)
        self._held = name

    def loosen(self) -> None:
        """Release the held object. The hand passes through it until ``part_from``: fingers must not drag it along."""
        self.robot.let_go()
        if self._held:
            self.bodies.wake((self._held,))
            self._held = ""

    def part_from(self, name: str) -> None:
        """Restore collisions with a released object after the hand has left it."""
        self.robot.collide(self.bodies.body(name), self.bodies.links(name), on=True)

    def hook(self, name: str, joint: int) -> None:
        """Attach the hand's point to the panel that a joint of the object moves."""
        link = self.bodies.panel_link(name, joint)
        tool = self.robot.hand_pose()
        point = tool.apply((0.0, 0.0, TIP_M))
        state = self._bullet.getLinkState(self.bodies.body(name), link, computeForwardKinematics=1)
        self.bodies.wake((name,))
        in_link = Pose(tuple(state[4]), tuple(state[5])).inverse().apply(point)
        self.robot.hook(self.bodies.body(name), link, (0.0, 0.0, TIP_M), in_link)
        self.robot.brush(self.bodies.body(name), link, on=False)
        self._hooked = (name, link)

    def unhook(self) -> None:
        """Release a panel. The hand passes through it until ``part``: fingers must not drag it along."""
        self.robot.let_go()

    def part(self) -> None:
        """Restore collisions with the panel after the hand has left it."""
        name, link = self._hooked
        self.robot.brush(self.bodies.body(name), link, on=True)

    def close(self) -> None:
        """Free the client and end the world's use."""
        self._bullet.disconnect()
