"""The robot's body as balls: where its links are for many postures at once, to see what is free without asking physics.

A posture is a row of eleven numbers: the base's x, y and heading, the lift's height, and the arm's seven angles.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim import physical_arm as arm

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from embomatrix.world.geometry import FloatArray

    BoolArray = NDArray[np.bool_]

MOUNT_LOW_M: Final = 0.43
MOUNT_AHEAD_M: Final = 0.12
LIFT_M: Final = 0.76
COLUMN_M: Final = 0.10
"""Radius of the column below the arm, with a little air."""
BASE_M: Final = 0.26
BASE_TOP_M: Final = 0.31
NUMBERS: Final = 4 + arm.JOINTS
X, Y, YAW, LIFT, ARM = 0, 1, 2, 3, slice(4, None)

_BALLS: Final = (
    (0, ((0, 0, -0.15, 0.06), (0, 0, -0.07, 0.06), (0, 0, 0, 0.06), (0, -0.07, 0, 0.06))),
    (1, ((0, 0, 0, 0.06), (0, 0, 0.075, 0.06), (0, -0.07, 0, 0.06), (0, -0.14, 0, 0.06))),
    (2, ((0, 0, -0.06, 0.06), (0, 0, 0, 0.06), (0.08, 0, 0, 0.06), (0.08, 0.055, 0, 0.06))),
    (3, ((0, 0, 0, 0.06), (0, 0, 0.055, 0.06), (-0.08, 0.065, 0, 0.06), (-0.04, 0.03, 0, 0.06))),
    (
        4,
        (
            (0, 0, -0.21, 0.055),
            (0, 0.03, -0.15, 0.055),
            (0, 0.07, -0.08, 0.05),
            (0, 0.07, 0, 0.06),
            (0, 0, 0, 0.055),
        ),
    ),
    (5, ((0, 0, 0, 0.055), (0.05, 0.01, 0, 0.055), (0.088, 0.025, 0, 0.055))),
    (6, ((0, 0, 0.065, 0.05), (0.045, 0.045, 0.08, 0.045))),
    (
        7,
        (
            *((0.0, y, -0.09, 0.034) for y in (-0.07, -0.035, 0.0, 0.035, 0.07)),
            (0, 0, -0.125, 0.04),
            *((0.0, y, z, 0.014) for y in (-0.03, 0.0, 0.03) for z in (-0.04, -0.02)),
        ),
    ),
)
"""Balls (x, y, z, radius) in the frames of the arm's links: a cover of the collision meshes."""
_LINK: Final = np.array([link for link, balls in _BALLS for _ in balls])
_CENTRE: Final = np.array([ball[:3] for _, balls in _BALLS for ball in balls])
RADII: Final = np.array([ball[3] for _, balls in _BALLS for ball in balls])
"""Radius of each ball of the arm."""
HAND_BALLS: Final = _LINK == 7
"""Which of them are the hand's."""
_MOVING: Final = _LINK >= 3
_TRUNK: Final = np.array([[-0.06, 0.0, 0.06, 0.085], [0.0, 0.0, 0.06, 0.09]])
"""Balls of the arm's foot, in the mount's frame."""


def mounts(postures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frames of the arm's mount in the world: rotations (n, 3, 3) and positions (n, 3)."""
    turn = arm.about_z(postures[:, YAW])
    place = turn[:, :, 0] * MOUNT_AHEAD_M
    place = place + np.stack([postures[:, X], postures[:, Y], postures[:, LIFT] + MOUNT_LOW_M], axis=1)
    return turn, place


def tools(postures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frames of the tool in the world: rotations (n, 3, 3) and positions (n, 3)."""
    turn, place = mounts(postures)
    rotation, position = arm.frames(postures[:, ARM])
    return turn @ rotation[:, 7], place + np.einsum("nij,nj->ni", turn, position[:, 7])


def balls(postures: FloatArray) -> FloatArray:
    """Centres of the arm's balls in the world, (n, balls, 3); radii are ``RADII``."""
    turn, place = mounts(postures)
    rotation, position = arm.frames(postures[:, ARM])
    local = position[:, _LINK] + np.einsum("nbij,bj->nbi", rotation[:, _LINK], _CENTRE)
    return np.asarray(place[:, None] + np.einsum("nij,nbj->nbi", turn, local))


def trunk_balls(postures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres (n, balls, 3) and radii (balls,) of the base, the column and the arm's foot."""
    turn, place = mounts(postures)
    foot = place[:, None] + np.einsum("nij,bj->nbi", turn, _TRUNK[:, :3])
    ring = np.array([(0.125 * math.cos(a), 0.125 * math.sin(a)) for a in np.arange(6) * math.pi / 3])
    base = np.zeros((len(postures), 6, 3))
    base[:, :, :2] = postures[:, None, :2] + ring
    base[:, :, 2] = 0.17
    column = np.zeros((len(postures), 6, 3))
    column[:, :, :2] = postures[:, None, :2]
    shares = np.linspace(0.0, 1.0, 6)
    column[:, :, 2] = 0.4 + shares * (place[:, 2, None] - 0.45)
    radii = np.concatenate([_TRUNK[:, 3], np.full(6, 0.13), np.full(6, 0.085)])
    return np.concatenate([foot, base, column], axis=1), radii


def strikes_itself(
    postures: FloatArray, extra: FloatArray | None = None, radii: FloatArray | None = None
) -> BoolArray:
    """Whether forearm, hand or what it holds touch the robot's own foot, column or base, shape (n,).

    ``extra``: (n, k, 3) centres of balls that the hand holds, with their ``radii`` (k,).
    """
    points = balls(postures)[:, _MOVING]
    sizes = RADII[_MOVING]
    if extra is not None and radii is not None:
        points = np.concatenate([points, extra], axis=1)
        sizes = np.concatenate([sizes, radii])
    turn, place = mounts(postures)
    seen = np.einsum("nji,nbj->nbi", turn, points - place[:, None])  # in the mount's frame
    x, y, z = seen[..., 0] + MOUNT_AHEAD_M, seen[..., 1], seen[..., 2]
    off = np.hypot(x, y)
    floor = -place[:, 2, None]
    column = (off < COLUMN_M + sizes) & (z < sizes)
    base = (off < BASE_M + sizes) & (z < floor + BASE_TOP_M + sizes)
    foot = (np.hypot(seen[..., 0], y) < 0.09 + sizes) & (z < 0.14 + sizes)
    foot |= (np.hypot(seen[..., 0], y) < 0.055 + sizes) & (z < 0.38 + sizes)
    return np.asarray((column | base | foot).any(axis=1))


def solve(
    rotation: FloatArray, position: FloatArray, bases: FloatArray, lifts: FloatArray, last: FloatArray
) -> FloatArray:
    """Postures that bring the tool to poses in the world, (n, 4, 11), NaN where there is none.

    rotation: (n, 3, 3), position: (n, 3), bases: (n, 3) x, y, heading; lifts: (n,); last: (n,) angles of the last joint.
    """
    turn = arm.about_z(bases[:, 2])
    place = turn[:, :, 0] * MOUNT_AHEAD_M
    place[:, :2] += bases[:, :2]
    place[:, 2] = lifts + MOUNT_LOW_M
    local = np.einsum("nji,njk->nik", turn, rotation)
    found = arm.solve(local, np.einsum("nji,nj->ni", turn, position - place), last)
    postures = np.empty((len(bases), arm.BRANCHES, NUMBERS))
    postures[:, :, :3] = bases[:, None]
    postures[:, :, LIFT] = lifts[:, None]
    postures[:, :, ARM] = found
    return postures
