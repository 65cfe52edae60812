"""Passages: motions of the robot through free space, made without letting time pass.

Who drives or folds an arm where nothing is near, with motors that are strong enough, is in the end where the motion ends, and
nothing else has moved. Whether nothing is near is asked of Bullet itself, with every link of the robot and what it holds at
one posture after another; wherever something is, the motion is made in time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.sim.bullet.client import pybullet

if TYPE_CHECKING:
    from collections.abc import Iterable

    from embomatrix.sim.bullet.dynamic_bodies import DynamicBodies
    from embomatrix.sim.bullet.robot import Posture, RobotBody
    from embomatrix.world.geometry import Pose

CLEAR_M: Final = 0.005
"""Nothing may be nearer: so far a motion that is made in time strays from its way. Bullet tells of contacts up to 2 cm off."""
DISTANCE: Final = 8
"""Where a contact has its distance."""


class Passage:
    """One motion of a robot with what its hand holds, ``""`` for nothing, from where both are now."""

    def __init__(self, client: int, robot: RobotBody, bodies: DynamicBodies, held: str) -> None:
        self._bullet = pybullet()
        self._client = client
        self._robot = robot
        self._bodies = bodies
        self._held = held
        self._start = robot.posture
        self._load = bodies.pose(held) if held else None
        self._pose_hand_load = robot.hand_pose().inverse() @ self._load if self._load is not None else None

    @property
    def is_loaded(self) -> bool:
        """Whether the hand holds something."""
        return bool(self._held)

    def is_clear(self, postures: Iterable[Posture]) -> bool:
        """Whether nothing comes near where the motion starts or at any of some postures, all of which the joints' limits allow.

        All is left as it was.
        """
        clear = self._nothing_near() and all(self._nothing_near_at(posture) for posture in postures)
        self._robot.stand(self._start)
        if self._load is not None:
            self._carry(self._load)
        return clear

    def stand(self, posture: Posture) -> None:
        """Be in a posture at once, at rest, with what the hand holds."""
        self._robot.stand(posture)
        if self._pose_hand_load is not None:
            self._carry(self._robot.hand_pose() @ self._pose_hand_load)

    def _carry(self, pose: Pose) -> None:
        """Have the load at a pose, at rest."""
        bullet, client, body = self._bullet, self._client, self._bodies.body(self._held)
        bullet.resetBasePositionAndOrientation(body, pose.position_m, pose.quat_xyzw, physicsClientId=client)
        bullet.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0), physicsClientId=client)

    def _nothing_near_at(self, posture: Posture) -> bool:
        if not self._robot.can_stand(posture):
            return False
        self.stand(posture)
        return self._nothing_near()

    def _nothing_near(self) -> bool:
        """Contacts that Bullet tells of are new after each detection, whatever was near before."""
        self._bullet.performCollisionDetection(physicsClientId=self._client)
        moved = [self._robot.body, *([self._bodies.body(self._held)] if self._held else [])]
        return not any(
            contact[DISTANCE] < CLEAR_M
            for body in moved
            for contact in self._bullet.getContactPoints(bodyA=body, physicsClientId=self._client)
        )
