"""Kinematics of the robot's arm in closed form, for many poses at once: no physics engine, no iteration.

The arm is a Franka Panda: a spherical shoulder, an elbow with two equal offsets, and a wrist whose last axis is offset. With
the angle of the last joint given, the six others follow geometrically; He and Liu, "Analytical inverse kinematics for
Franka Emika Panda", 2021, solve it in the same way. Lengths are those of the installed ``pybullet_data`` package's URDF.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from embomatrix.world.geometry import FloatArray

JOINTS: Final = 7
LOW_RAD: Final = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
HIGH_RAD: Final = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""The arm's soft limits: its controller stops before the hard ones."""
SHOULDER_M: Final = 0.333
UPPER_M: Final = 0.316
FOREARM_M: Final = 0.384
ELBOW_M: Final = 0.0825
WRIST_M: Final = 0.088
FLANGE_M: Final = 0.107
TOOL_M: Final = 0.1122
"""From the flange to the fingertips' ends: the point by which the hand touches things."""
HAND_TURN: Final = -math.pi / 4
"""The hand is mounted askew on the flange."""
BRANCHES: Final = 4
"""Solutions for one pose and one angle of the last joint: two of the wrist times two of the shoulder."""
_UPPER = np.array([ELBOW_M, UPPER_M])
_FORE = np.array([-ELBOW_M, FOREARM_M])
_P = float(_UPPER @ _FORE)
_Q = float(_UPPER[1] * _FORE[0] - _UPPER[0] * _FORE[1])
_ALONG, _SWAY = math.hypot(_P, _Q), math.atan2(_Q, _P)


def frames(joints: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frames of the seven links and of the tool, in the frame of the arm's mount.

    joints: (n, 7). Returns rotations (n, 8, 3, 3) and positions (n, 8, 3); index 7 is the tool, at the fingertips' end with
    z out of the hand and y along the fingers' travel.
    """
    n = len(joints)
    rotation, position = np.zeros((n, 8, 3, 3)), np.zeros((n, 8, 3))
    turn, place = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
    for index, (offset, tilt) in enumerate(_CHAIN):
        place = place + turn @ offset
        turn = turn @ tilt @ about_z(joints[:, index])
        rotation[:, index], position[:, index] = turn, place
    rotation[:, 7] = turn @ about_z(np.full(n, HAND_TURN))
    position[:, 7] = place + turn[:, :, 2] * (FLANGE_M + TOOL_M)
    return rotation, position


def solve(rotation: FloatArray, position: FloatArray, last: FloatArray) -> FloatArray:
    """Joint angles that bring the tool to poses in the mount's frame, shape (n, 4, 7); NaN where a branch has none.

    rotation: (n, 3, 3), position: (n, 3), last: (n,) angles of the last joint. Angles keep the soft limits.
    """
    seven = rotation @ about_z(np.full(len(last), -HAND_TURN))
    six = seven @ about_z(-last) @ _tilt(-1)  # after joint 6, (n, 3, 3)
    wrist = position - rotation[:, :, 2] * (FLANGE_M + TOOL_M) - six[:, :, 0] * WRIST_M
    back = np.array([0.0, 0.0, SHOULDER_M]) - wrist  # wrist to shoulder, (n, 3)
    length = np.linalg.norm(back, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        bend = _SWAY - np.arccos((length**2 - _UPPER @ _UPPER - _FORE @ _FORE) / (2 * _ALONG))  # joint 4
        found = [
            _rest(six, back, length, bend, last, wrist_sign, shoulder_sign)
            for wrist_sign in (1.0, -1.0)
            for shoulder_sign in (1.0, -1.0)
        ]
        angles = np.stack(found, axis=1)  # (n, 4, 7)
        good = ((angles >= LOW_RAD) & (angles <= HIGH_RAD)).all(axis=2)
    angles[~good] = np.nan
    return angles


def _rest(
    six: FloatArray,
    back: FloatArray,
    length: FloatArray,
    bend: FloatArray,
    last: FloatArray,
    wrist_sign: float,
    shoulder_sign: float,
) -> FloatArray:
    """All seven angles of one branch, shape (n, 7)."""
    s, c = np.sin(bend), np.cos(bend)
    out_x = ELBOW_M - ELBOW_M * c - FOREARM_M * s  # wrist seen from the shoulder, in the elbow's plane
    out_z = UPPER_M - ELBOW_M * s + FOREARM_M * c
    cosine = (s * out_x - c * out_z) / length  # between the forearm's axis and the way back to the shoulder
    toward = np.einsum("nji,nj->ni", six, back) / length[:, None]
    reach = np.hypot(toward[:, 0], toward[:, 1])
    q6 = np.arctan2(toward[:, 0], toward[:, 1]) + wrist_sign * np.arccos(cosine / reach)
    q6 = np.remainder(q6 + math.pi / 2, math.tau) - math.pi / 2  # the joint's travel starts at about zero
    forearm = six[:, :, 0] * np.sin(q6)[:, None] + six[:, :, 1] * np.cos(q6)[:, None]
    normal = np.cross(forearm, back) / (-c * out_x - s * out_z)[:, None]  # y axis of link 3
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    across = np.cross(forearm, -normal)  # x axis of link 4
    five = six @ about_z(-q6) @ _tilt(-1)
    elbow = np.stack([across, normal, forearm], axis=2)
    turned = np.einsum("nji,njk->nik", elbow, five)
    q5 = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    x3 = c[:, None] * across - s[:, None] * forearm
    z3 = s[:, None] * across + c[:, None] * forearm
    q2 = shoulder_sign * np.arctan2(np.hypot(z3[:, 0], z3[:, 1]), z3[:, 2])
    q1 = np.arctan2(shoulder_sign * z3[:, 1], shoulder_sign * z3[:, 0])
    # The third angle is what the first two leave: exact with the upper arm upright too, where they are arbitrary.
    ahead = np.cos(q1) * x3[:, 0] + np.sin(q1) * x3[:, 1]
    aside = np.cos(q1) * x3[:, 1] - np.sin(q1) * x3[:, 0]
    q3 = np.arctan2(aside, np.cos(q2) * ahead - np.sin(q2) * x3[:, 2])
    return np.stack([q1, q2, q3, bend, q5, q6, last], axis=1)


def about_z(angles: FloatArray) -> FloatArray:
    """Rotations about z, shape (n, 3, 3)."""
    s, c, o = np.sin(angles), np.cos(angles), np.zeros(len(angles))
    return np.stack([np.stack([c, -s, o], 1), np.stack([s, c, o], 1), np.stack([o, o, o + 1], 1)], 1)


def _tilt(sign: int) -> FloatArray:
    """Rotation by a right angle about x."""
    return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -sign], [0.0, sign, 0.0]])


_CHAIN: Final = (
    (np.array([0.0, 0.0, SHOULDER_M]), np.eye(3)),
    (np.zeros(3), _tilt(-1)),
    (np.array([0.0, -UPPER_M, 0.0]), _tilt(1)),
    (np.array([ELBOW_M, 0.0, 0.0]), _tilt(1)),
    (np.array([-ELBOW_M, FOREARM_M, 0.0]), _tilt(-1)),
    (np.zeros(3), _tilt(1)),
    (np.array([WRIST_M, 0.0, 0.0]), _tilt(1)),
)
"""Where each joint sits on the link before it, and how its axis is tilted against that link."""
