"""The robot as pictures show it: its visual meshes, put into a posture, in a stage's client."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bullet.client import pybullet
from embomatrix.sim.bullet.robot import spread
from embomatrix.sim.bullet.robot_model import ARM_JOINTS, BASE_JOINTS, FINGER_JOINTS, LIFT_JOINTS, robot_urdf

if TYPE_CHECKING:
    from embomatrix.sim.bullet.robot import Posture

_CHASSIS: Final = (0.78, 0.16, 0.14, 1.0)
_OWN_LINKS: Final = frozenset({"base", "stage", "carriage"})


class RobotFigure:
    """One robot in a client that has Bullet's renderer. It lives as long as the client."""

    def __init__(self, client: int) -> None:
        """Load the robot, out of sight. Raises EngineMissingError where its description is not installed."""
        self._bullet = bullet = pybullet()
        self._client = client
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(robot_urdf(visuals=True))
            self._body = int(bullet.loadURDF(str(path), useFixedBase=True, physicsClientId=client))
        joints: dict[str, int] = {}
        for number in range(bullet.getNumJoints(self._body, physicsClientId=client)):
            info = bullet.getJointInfo(self._body, number, physicsClientId=client)
            joints[info[1].decode()] = number
            if info[12].decode() in _OWN_LINKS:
                bullet.changeVisualShape(self._body, number, rgbaColor=_CHASSIS, physicsClientId=client)
        self._driven = [joints[name] for name in (*BASE_JOINTS, *LIFT_JOINTS, *ARM_JOINTS, *FINGER_JOINTS)]
        self.leave()

    def stand(self, posture: Posture) -> None:
        """Show the robot in a posture."""
        self._put(0.0)
        for joint, value in zip(self._driven, spread(posture), strict=True):
            self._bullet.resetJointState(self._body, joint, value, physicsClientId=self._client)

    def leave(self) -> None:
        """Take it out of sight: the robot does not see itself."""
        self._put(-100.0)

    def _put(self, height_m: float) -> None:
        self._bullet.resetBasePositionAndOrientation(
            self._body, (0.0, 0.0, height_m), (0.0, 0.0, 0.0, 1.0), physicsClientId=self._client
        )
