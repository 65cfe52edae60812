"""Passages: instant motions of the robot through free space.

If nothing is near, a stepped motion with strong enough motors ends where it should and moves nothing else, so no steps are
needed. Bullet checks every link of the robot and the held object at each posture; a motion near anything is stepped instead.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bullet.client import BulletClient

if TYPE_CHECKING:
    from embomatrix.sim.bullet.dynamic_bodies import DynamicBodies
    from embomatrix.sim.bullet.robot import Posture, RobotBody
    from embomatrix.world.geometry import Pose

CLEAR_M: Final = 0.005
"""Required clearance: a stepped motion deviates this far from its path. Bullet reports contacts up to 2 cm away."""
DISTANCE: Final = 8
"""Index of the distance in a contact."""


class Passage:
    """Motion of a robot with its held object (``""`` for none) from their current state."""

    def __init__(self, client: BulletClient, robot: RobotBody, bodies: DynamicBodies, held: str) -> None:
        self._bullet = client
        self._robot = robot
        self._bodies = bodies
        self._held = held
        self._start = robot.posture
        self._load = bodies.pose(held) if held else None
        self._pose_hand_load = robot.hand_pose().inverse() @ self._load if self._load is not None else None

    @property
    def is_loaded(self) -> bool:
        """True if the hand holds something."""
        return bool(self._held)

    def is_clear(self, postures: Iterable[Posture]) -> bool:
        """Return True if nothing is near at the start or at any of the postures, and joint limits allow all of them.

        The state is restored.
        """
        clear = self._nothing_near() and all(self._nothing_near_at(posture) for posture in postures)
        self._robot.stand(self._start)
        if self._load is not None:
            self._carry(self._load)
        return clear

    def stand(self, posture: Posture) -> None:
        """Move to a posture at once, at rest, with the held object."""
        self._robot.stand(posture)
        if self._pose_hand_load is not None:
            self._carry(self._robot.hand_pose() @ self._pose_hand_load)

    def _carry(self, pose: Pose) -> None:
        """Put the held object at a pose, at rest."""
        bullet, body = self._bullet, self._bodies.body(self._held)
        bullet.resetBasePositionAndOrientation(body, pose.position_m, pose.quat_xyzw)
        bullet.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0))

    def _nothing_near_at(self, posture: Posture) -> bool:
        if not self._robot.can_stand(posture):
            return False
        self.stand(posture)
        return self._nothing_near()

    def _nothing_near(self) -> bool:
        """Each detection refreshes the contacts that Bullet reports."""
        self._bullet.performCollisionDetection()
        moved = [self._robot.body, *([self._bodies.body(self._held)] if self._held else [])]
        return not any(
            contact[DISTANCE] < CLEAR_M
            for body in moved
            for contact in self._bullet.getContactPoints(bodyA=body)
        )
