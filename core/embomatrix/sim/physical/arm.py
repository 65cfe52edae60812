"""Closed-form kinematics of the robot's arm for many poses at once, without a physics engine and without iteration.

The arm is a Franka Panda: a spherical shoulder, an elbow with two equal offsets, and a wrist with an offset last axis. With
the angle of the last joint given, the six others follow geometrically, as in He and Liu, "Analytical inverse kinematics for
Franka Emika Panda", 2021. Lengths are those of the URDF in the installed ``pybullet_data`` package.
"""

import math
from typing import Final

import numpy as np

from embomatrix.world.geometry import FloatArray

JOINTS: Final = 7
LOW_RAD: Final = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
HIGH_RAD: Final = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""Soft joint limits: the controller stops before the hard ones."""
SHOULDER_M: Final = 0.333
UPPER_M: Final = 0.316
FOREARM_M: Final = 0.384
ELBOW_M: Final = 0.0825
WRIST_M: Final = 0.088
FLANGE_M: Final = 0.107
TOOL_M: Final = 0.1122
"""Distance from the flange to the ends of the fingertips, the contact point of the hand."""
HAND_TURN: Final = -math.pi / 4
"""Angle by which the hand is mounted on the flange."""
BRANCHES: Final = 4
"""Solutions for one pose and one angle of the last joint: two of the wrist times two of the shoulder."""
_UPPER = np.array([ELBOW_M, UPPER_M])
_FORE = np.array([-ELBOW_M, FOREARM_M])
_P = float(_UPPER @ _FORE)
_Q = float(_UPPER[1] * _FORE[0] - _UPPER[0] * _FORE[1])
_WRIST_SIGNS: Final = np.array([[1.0], [-1.0]])
_ALONG, _SWAY = math.hypot(_P, _Q), math.atan2(_Q, _P)


def frames(joints: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the frames of the seven links and of the tool, in the frame of the arm's mount.

    joints: (n, 7). Returns rotations (n, 8, 3, 3) and positions (n, 8, 3). Index 7 is the tool at the fingertips, with z out of
    the hand and y along the travel of the fingers.
    """
    rotation, position = np.empty((len(joints), 8, 3, 3)), np.empty((len(joints), 8, 3))
    sines, cosines = np.sin(joints.T), np.cos(joints.T)
    x, y, z = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, len(joints)))  # axes of the link, (3, n) each
    place = np.zeros((3, len(joints)))
    for index, (along_x, along_y, along_z, tilt) in enumerate(_CHAIN):
        for axis, offset in ((x, along_x), (y, along_y), (z, along_z)):
            if offset:
                place = place + axis * offset
        if tilt:
            y, z = tilt * z, -tilt * y
        x, y = cosines[index] * x + sines[index] * y, cosines[index] * y - sines[index] * x
        for number, axis in enumerate((x, y, z)):
            rotation[:, index, :, number] = axis.T
        position[:, index] = place.T
    x, y = (
        math.cos(HAND_TURN) * x + math.sin(HAND_TURN) * y,
        math.cos(HAND_TURN) * y - math.sin(HAND_TURN) * x,
    )
    for number, axis in enumerate((x, y, z)):
        rotation[:, 7, :, number] = axis.T
    position[:, 7] = (place + z * (FLANGE_M + TOOL_M)).T
    return rotation, position


def solve(rotation: FloatArray, position: FloatArray, last: FloatArray) -> FloatArray:
    """Return joint angles that bring the tool to poses in the mount's frame, shape (n, 4, 7); NaN for branches without one.

    rotation: (n, 3, 3), position: (n, 3), last: (n,) angles of the last joint. Angles keep the soft limits.
    """
    six = rotation @ _about_z_then_tilted(-HAND_TURN - last)  # after joint 6, (n, 3, 3)
    wrist = position - rotation[:, :, 2] * (FLANGE_M + TOOL_M) - six[:, :, 0] * WRIST_M
    back = np.array([0.0, 0.0, SHOULDER_M]) - wrist  # wrist to shoulder, (n, 3)
    with np.errstate(invalid="ignore", divide="ignore"):
        angles = _branches(six.transpose(2, 1, 0), back.T, last)
        good = ((angles >= LOW_RAD) & (angles <= HIGH_RAD)).all(axis=2)
    angles[~good] = np.nan
    return angles


def _branches(six: FloatArray, back: FloatArray, last: FloatArray) -> FloatArray:
    """Return all seven angles of every branch, shape (n, 4, 7), without regard to joint limits.

    six: axes of the frame after joint 6, (3 axes, 3, n); back: vector from wrist to shoulder, (3, n). Vectors lie along
    the first axis and wrist branches along the second: (3, 2, n).
    """
    length = np.sqrt(_dot(back, back))
    bend = _SWAY - np.arccos((length**2 - _UPPER @ _UPPER - _FORE @ _FORE) / (2 * _ALONG))  # joint 4
    s, c = np.sin(bend), np.cos(bend)
    out_x = ELBOW_M - ELBOW_M * c - FOREARM_M * s  # wrist seen from the shoulder, in the elbow's plane
    out_z = UPPER_M - ELBOW_M * s + FOREARM_M * c
    cosine = (
        s * out_x - c * out_z
    )  # between the forearm's axis and the vector back to the shoulder, times its length
    ahead, aside = _dot(six[0], back), _dot(six[1], back)
    q6 = np.arctan2(ahead, aside) + _WRIST_SIGNS * np.arccos(cosine / np.hypot(ahead, aside))
    q6 = np.remainder(q6 + math.pi / 2, math.tau) - math.pi / 2  # the joint's travel starts at about zero
    s6, c6 = np.sin(q6), np.cos(q6)
    forearm = six[0][:, None] * s6 + six[1][:, None] * c6
    normal = _cross(forearm, back[:, None]) * np.copysign(1.0, -c * out_x - s * out_z)  # y axis of link 3
    normal = normal / np.sqrt(_dot(normal, normal))
    across = _cross(normal, forearm)  # x axis of link 4
    five = six[0][:, None] * c6 - six[1][:, None] * s6  # x axis of link 5
    q5 = np.arctan2(_dot(normal, five), _dot(across, five))
    x3 = c * across - s * forearm
    z3 = s * across + c * forearm
    tilt = np.arctan2(np.hypot(z3[0], z3[1]), z3[2])
    angles = np.empty((len(last), BRANCHES, JOINTS))
    for number, sign in enumerate((1.0, -1.0)):
        q1, q2 = np.arctan2(sign * z3[1], sign * z3[0]), sign * tilt
        # The third angle follows from the first two. This is exact for an upright upper arm too, where those are arbitrary.
        s1, c1 = np.sin(q1), np.cos(q1)
        q3 = np.arctan2(c1 * x3[1] - s1 * x3[0], np.cos(q2) * (c1 * x3[0] + s1 * x3[1]) - np.sin(q2) * x3[2])
        for joint, column in enumerate((q1, q2, q3, bend, q5, q6, last)):
            angles[:, number::2, joint] = column.T if column.ndim == 2 else column[:, None]
    return angles


def _dot(one: FloatArray, other: FloatArray) -> FloatArray:
    """Inner products of vectors along the first axis, written out because these arrays are small."""
    return np.asarray(one[0] * other[0] + one[1] * other[1] + one[2] * other[2])


def _cross(one: FloatArray, other: FloatArray) -> FloatArray:
    """Cross products of vectors along the first axis."""
    return np.stack(
        (
            one[1] * other[2] - one[2] * other[1],
            one[2] * other[0] - one[0] * other[2],
            one[0] * other[1] - one[1] * other[0],
        )
    )


def _about_z_then_tilted(angles: FloatArray) -> FloatArray:
    """Rotations about z, then by a right angle back about x, shape (n, 3, 3)."""
    found = np.zeros((len(angles), 3, 3))
    found[:, 0, 0] = found[:, 1, 2] = np.cos(angles)
    found[:, 1, 0] = np.sin(angles)
    found[:, 0, 2] = -found[:, 1, 0]
    found[:, 2, 1] = -1.0
    return found


def strain(angles: FloatArray) -> FloatArray:
    """Distance of joints, (n, 7), from the middle of their travel, (n,), in units without dimension."""
    middle, half = (HIGH_RAD + LOW_RAD) / 2, (HIGH_RAD - LOW_RAD) / 2
    return np.asarray((((angles - middle) / half) ** 4).sum(axis=1))


def about_z(angles: FloatArray) -> FloatArray:
    """Rotations about z, shape (n, 3, 3)."""
    found = np.zeros((len(angles), 3, 3))
    found[:, 0, 0] = found[:, 1, 1] = np.cos(angles)
    found[:, 1, 0] = np.sin(angles)
    found[:, 0, 1] = -found[:, 1, 0]
    found[:, 2, 2] = 1.0
    return found


_CHAIN: Final = (
    (0.0, 0.0, SHOULDER_M, 0),
    (0.0, 0.0, 0.0, -1),
    (0.0, -UPPER_M, 0.0, 1),
    (ELBOW_M, 0.0, 0.0, 1),
    (-ELBOW_M, FOREARM_M, 0.0, -1),
    (0.0, 0.0, 0.0, 1),
    (WRIST_M, 0.0, 0.0, 1),
)
"""Offset x, y, z of each joint on the link before it, and the tilt of its axis about x in right angles."""
