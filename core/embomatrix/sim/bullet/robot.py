"""Robot in a Bullet client: limited motors, contacts of its links, and the hold of its hand."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from embomatrix.sim.bullet.client import BulletClient
from embomatrix.sim.bullet.robot_model import (
    DRIVEN_JOINTS,
    FINGER_JOINTS,
    HAND,
    SHOULDER_EFFORT_NM,
    WRIST_EFFORT_NM,
    robot_urdf,
)
from embomatrix.sim.robot_dimensions import STAGE_SHARE
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import StandPose

BASE_N: Final = 1000.0
BASE_NM: Final = 200.0
LIFT_N: Final = 1500.0
FINGER_N: Final = 30.0
GRIP_N: Final = 400.0
"""Largest force of the hand's hold."""
GAIN: Final = 0.3
"""Share of the distance to its target that a motor covers per step, as far as its force allows."""
FINGERS_OPEN_M: Final = 0.02
TUCKED_ARM: Final = (-1.57, 1.57, 0.0, -0.4, 0.0, 2.6, 0.785)
"""Joint angles of the empty arm while the robot drives: upright over the base, within its disc, below what it drives under."""
TUCKED_LIFT_M: Final = 0.0
SAG: Final = 1e-3
"""Metres or radians by which loads bend joints beyond their limits."""


@dataclass(frozen=True, slots=True)
class Posture:
    """Joint positions of the robot: base in the world, height of the lift, the arm's seven angles."""

    x_m: float
    y_m: float
    yaw: float
    lift_m: float
    arm: tuple[float, ...]

    @property
    def numbers(self) -> tuple[float, ...]:
        return (self.x_m, self.y_m, self.yaw, self.lift_m, *self.arm)

    @staticmethod
    def of(numbers: Sequence[float]) -> Posture:
        x, y, yaw, lift, *arm = map(float, numbers)
        return Posture(x, y, yaw, lift, tuple(arm))


def tucked(at: StandPose) -> Posture:
    """Posture of the robot at a standing pose with its empty arm tucked, as it drives."""
    return Posture(at.x_m, at.y_m, at.yaw, TUCKED_LIFT_M, TUCKED_ARM)


def load_robot(client: BulletClient, *, visuals: bool = False) -> int:
    """Load the robot into a client and return its body. Raises EngineMissingError if its description is not installed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(robot_urdf(visuals=visuals))
        return int(client.loadURDF(str(path), useFixedBase=True))


class RobotBody:
    """Robot loaded into a client, until the client is reset."""

    def __init__(self, client: BulletClient, posture: Posture) -> None:
        """Load the robot with its joints at a posture."""
        self._bullet = client
        self.body = load_robot(client)
        infos = [client.getJointInfo(self.body, joint) for joint in range(client.getNumJoints(self.body))]
        joints = {info[1].decode(): int(info[0]) for info in infos}
        links = {info[12].decode(): int(info[0]) for info in infos}
        self.hand = links[HAND]
        self.tips = frozenset((self.hand, *(joints[name] for name in FINGER_JOINTS)))
        self.base = links["base"]
        self._driven = [joints[name] for name in DRIVEN_JOINTS]
        self._limits = [infos[joint][8:10] for joint in self._driven]
        self._forces = [BASE_N] * 2 + [BASE_NM] + [LIFT_N] * 2
        self._forces += [SHOULDER_EFFORT_NM] * 4 + [WRIST_EFFORT_NM] * 3 + [FINGER_N] * 2
        self._inertial = Pose(tuple(client.getDynamicsInfo(self.body, self.hand)[3]))
        self._hold = -1
        self.appear(posture)

    def appear(self, posture: Posture) -> None:
        """Move to a posture at once and hold it, regardless of obstacles."""
        self.stand(posture)
        self.steer(posture)

    def stand(self, posture: Posture) -> None:
        """Move to a posture at once, at rest. The motors keep their targets."""
        values = spread(posture)
        self._bullet.resetJointStatesMultiDof(
            self.body, self._driven, [(value,) for value in values], [(0.0,)] * len(values)
        )

    def can_stand(self, posture: Posture) -> bool:
        """Return True if every joint of a posture is within its limits, with a small tolerance. Free joints have none."""
        return all(
            low > high or low - SAG <= value <= high + SAG
            for (low, high), value in zip(self._limits, spread(posture), strict=True)
        )

    @property
    def posture(self) -> Posture:
        """Current joint positions."""
        states = self._bullet.getJointStates(self.body, self._driven)
        values = [state[0] for state in states]
        return Posture.of((*values[:3], values[3] + values[4], *values[5:12]))

    def steer(self, posture: Posture) -> None:
        """Set the motors' targets, which they approach within their forces as time passes."""
        self._bullet.setJointMotorControlArray(
            self.body,
            self._driven,
            self._bullet.POSITION_CONTROL,
            targetPositions=spread(posture),
            forces=self._forces,
            positionGains=[GAIN] * len(self._driven),
        )

    def hold(self, body: int, link: int, pose_hand_body: Pose) -> None:
        """Attach a body's link to the hand at its current pose, up to the force of the grip."""
        centre = self._inertial.inverse() @ pose_hand_body
        self._hold = self._bullet.createConstraint(
            self.body,
            self.hand,
            body,
            link,
            self._bullet.JOINT_FIXED,
            (0, 0, 0),
            centre.position_m,
            (0, 0, 0),
            centre.quat_xyzw,
            (0, 0, 0, 1),
        )
        self._bullet.changeConstraint(self._hold, maxForce=GRIP_N)

    def hook(self, body: int, link: int, in_hand: Sequence[float], in_link: Sequence[float]) -> None:
        """Attach one point of a body's link to a point of the hand; the link may turn about it."""
        point = self._inertial.inverse().apply((in_hand[0], in_hand[1], in_hand[2]))
        self._hold = self._bullet.createConstraint(
            self.body, self.hand, body, link, self._bullet.JOINT_POINT2POINT, (0, 0, 0), point, tuple(in_link)
        )
        self._bullet.changeConstraint(self._hold, maxForce=GRIP_N)

    def let_go(self) -> None:
        """End the hold if there is one."""
        if self._hold >= 0:
            self._bullet.removeConstraint(self._hold)
            self._hold = -1

    def hand_pose(self) -> Pose:
        """Frame of the hand in the world: z points out of it, y along the fingers' travel."""
        state = self._bullet.getLinkState(self.body, self.hand, computeForwardKinematics=1)
        return Pose(tuple(state[4]), tuple(state[5]))

    def collide(self, body: int, links: Sequence[int], *, on: bool) -> None:
        """Switch collisions between the robot and a body's links: the held object must not push against it."""
        every = range(-1, self._bullet.getNumJoints(self.body))
        self._filter(body, links, every, on=on)

    def brush(self, body: int, link: int, *, on: bool) -> None:
        """Switch collisions between the hand and one link of a body."""
        self._filter(body, (link,), sorted(self.tips), on=on)

    def _filter(self, body: int, links: Sequence[int], own: Iterable[int], *, on: bool) -> None:
        for link in own:
            for other in links:
                self._bullet.setCollisionFilterPair(self.body, body, link, other, int(on))


def spread(posture: Posture) -> list[float]:
    """Values of the driven joints, base first, fingers last; the mast's inner stage rises with the carriage."""
    stage = posture.lift_m * STAGE_SHARE
    return [
        posture.x_m,
        posture.y_m,
        posture.yaw,
        stage,
        posture.lift_m - stage,
        *posture.arm,
        FINGERS_OPEN_M,
        FINGERS_OPEN_M,
    ]
