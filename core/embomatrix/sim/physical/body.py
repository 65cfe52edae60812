"""Ball model of the robot: positions of its links for many postures at once, for collision checks without physics.

A posture is a row of eleven numbers: x, y and heading of the base, height of the lift, and the arm's seven angles.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.physical import arm
from embomatrix.sim.robot_dimensions import (
    ASKEW_RAD,
    BASE_RADIUS_M,
    BASE_TOP_M,
    GROUND_M,
    MAST_SIZE_M,
    MAST_TOP_M,
    MAST_X_M,
    MOUNT_AXES,
    MOUNT_X_M,
    SHOULDER_LOW_M,
    STAGE_SHARE,
)
from embomatrix.world.geometry import FloatArray

BoolArray = NDArray[np.bool_]

CLEARANCE_M: Final = 0.01
"""Distance that the arm keeps from the robot's own trunk."""
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
"""Balls (x, y, z, radius) in the frames of the arm's links, which cover the collision meshes."""
_LINK: Final = np.array([link for link, balls in _BALLS for _ in balls])
_CENTRE: Final = np.array([ball[:3] for _, balls in _BALLS for ball in balls])
RADII: Final = np.array([ball[3] for _, balls in _BALLS for ball in balls])
"""Radius of each ball of the arm."""
HAND_BALLS: Final = _LINK == 7
"""Mask of the balls of the hand."""
_SWINGING: Final = _LINK >= 1
"""Mask of the balls that can touch the base or the mast."""
_MOVING: Final = _LINK[_SWINGING] >= 3
"""Mask, within the swinging balls, of those that can touch the arm's own foot and shoulder too."""
_MOUNT: Final = np.array(MOUNT_AXES)
_FOOT_LOW: Final = np.array([-0.154, -0.095, MAST_X_M - MOUNT_X_M])
_FOOT_HIGH: Final = np.array([0.072, 0.095, 0.14])
"""Corners of the box around the arm's foot and the carriage, in the mount's frame."""
_MAST_LOW: Final = np.array([MAST_X_M - MAST_SIZE_M[0] / 2, -MAST_SIZE_M[1] / 2, 0.0])
_MAST_HIGH: Final = np.array([MAST_X_M + MAST_SIZE_M[0] / 2, MAST_SIZE_M[1] / 2, MAST_TOP_M])
_STUB_M: Final = 0.055
"""Radius of the arm between its foot and its shoulder."""

_STAGE_BALLS: Final = 4
"""Pairs of balls at the top of the mast's inner stage."""


def _trunk() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the balls of base, mast, carriage and foot with the lift down: centres (k, 3) and radii (k,).

    The third array, (k,), is the share of the lift's height by which each ball rises.
    """
    thick = (BASE_TOP_M - GROUND_M) / 2
    ring = np.arange(10) * math.tau / 10
    around = (BASE_RADIUS_M - thick) * np.stack([np.cos(ring), np.sin(ring)], axis=1)
    base = np.column_stack([around, np.full(len(ring), GROUND_M + thick)])
    heights = np.arange(BASE_TOP_M, MAST_TOP_M, 0.09)
    mast = np.array([(MAST_X_M, y, z) for z in heights for y in (-0.04, 0.04)])
    foot = np.array([(x, y, SHOULDER_LOW_M) for x in (MOUNT_X_M, MOUNT_X_M + 0.09) for y in (-0.03, 0.08)])
    radii = np.concatenate(
        [np.full(len(base), thick), np.full(len(mast) + 2 * _STAGE_BALLS, 0.05), np.full(len(foot), 0.085)]
    )
    stage = mast[-2 * _STAGE_BALLS :]
    rises = np.repeat([0.0, STAGE_SHARE, 1.0], [len(base) + len(mast), len(stage), len(foot)])
    return np.concatenate([base, mast, stage, foot]), radii, rises


_TRUNK, _TRUNK_RADII, _RISES = _trunk()


def mounts(postures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the frames of the arm's mount in the world: rotations (n, 3, 3) and positions (n, 3)."""
    turn = arm.about_z(postures[:, YAW] + ASKEW_RAD)
    place = turn[:, :, 0] * MOUNT_X_M
    place = place + np.stack([postures[:, X], postures[:, Y], postures[:, LIFT] + SHOULDER_LOW_M], axis=1)
    return turn @ _MOUNT, place


def tools(postures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the frames of the tool in the world: rotations (n, 3, 3) and positions (n, 3)."""
    turn, place = mounts(postures)
    rotation, position = arm.frames(postures[:, ARM])
    return turn @ rotation[:, 7], place + np.einsum("nij,nj->ni", turn, position[:, 7])


def balls(postures: FloatArray) -> FloatArray:
    """Return the centres of the arm's balls in the world, (n, balls, 3). Their radii are ``RADII``."""
    turn, place = mounts(postures)
    rotation, position = arm.frames(postures[:, ARM])
    axes = rotation[:, _LINK]  # (n, balls, 3, 3)
    local = position[:, _LINK]
    for number in range(3):
        local += axes[..., number] * _CENTRE[:, number, None]
    return np.asarray(place[:, None] + local @ turn.transpose(0, 2, 1))


def forearm_balls(postures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centres (n, balls, 3) and radii (balls,) of the arm without its hand."""
    return balls(postures)[:, ~HAND_BALLS], RADII[~HAND_BALLS]


def trunk_balls(postures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centres (n, balls, 3) and radii (balls,) of the base, the mast, the carriage and the arm's foot."""
    centres = np.einsum("nij,bj->nbi", arm.about_z(postures[:, YAW] + ASKEW_RAD), _TRUNK)
    centres[:, :, :2] += postures[:, None, :2]
    centres[:, :, 2] += postures[:, LIFT, None] * _RISES
    return centres, _TRUNK_RADII


def self_collides(postures: FloatArray, points: FloatArray, radii: FloatArray) -> BoolArray:
    """Return a mask, (n,), of postures in which arm, hand or load touch the robot's own trunk or the arm's foot.

    points: (n, balls + k, 3), the arm's ``balls`` and then those of the load; radii: (balls + k,).
    """
    loads = np.ones(len(radii) - len(RADII), dtype=np.bool_)
    swinging = np.concatenate([_SWINGING, loads])
    points, sizes = points[:, swinging], radii[swinging] + CLEARANCE_M
    moving = np.concatenate([_MOVING, loads])
    turn, place = mounts(postures)
    seen = (points - place[:, None]) @ turn  # in the mount's frame
    local = seen @ _MOUNT.T
    local += np.array([MOUNT_X_M, 0.0, 0.0])
    local[:, :, 2] += place[:, None, 2]
    off = np.maximum(np.hypot(local[..., 0], local[..., 1]) - BASE_RADIUS_M, 0.0)
    base = np.hypot(off, np.maximum(local[..., 2] - BASE_TOP_M, 0.0)) < sizes
    local[:, :, 2] -= (postures[:, LIFT, None] * STAGE_SHARE) * (local[:, :, 2] > MAST_TOP_M)
    mast = _outside(local, _MAST_LOW, _MAST_HIGH) < sizes
    seen, sizes = seen[:, moving], sizes[moving]
    foot = _outside(seen, _FOOT_LOW, _FOOT_HIGH) < sizes
    beyond = np.maximum(np.abs(seen[..., 2] - arm.SHOULDER_M / 2) - arm.SHOULDER_M / 2, 0.0)
    foot |= np.hypot(np.hypot(seen[..., 0], seen[..., 1]), beyond) < _STUB_M + sizes
    return np.asarray((base | mast).any(axis=1) | foot.any(axis=1))


def _outside(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Distances of points, (n, b, 3), from a box between two corners, (n, b)."""
    off = np.maximum(np.maximum(low - points, points - high), 0.0)
    off *= off
    return np.asarray(np.sqrt(off[..., 0] + off[..., 1] + off[..., 2]))


def solve(
    rotation: FloatArray, position: FloatArray, bases: FloatArray, lifts: FloatArray, last: FloatArray
) -> FloatArray:
    """Return postures that bring the tool to poses in the world, (n, 4, 11), NaN for branches without one.

    rotation: (n, 3, 3), position: (n, 3), bases: (n, 3) x, y, heading; lifts: (n,); last: (n,) angles of the last joint.
    """
    turn, place = mounts(np.column_stack([bases, lifts]))
    local = np.einsum("nji,njk->nik", turn, rotation)
    found = arm.solve(local, np.einsum("nji,nj->ni", turn, position - place), last)
    postures = np.empty((len(bases), arm.BRANCHES, NUMBERS))
    postures[:, :, :3] = bases[:, None]
    postures[:, :, LIFT] = lifts[:, None]
    postures[:, :, ARM] = found
    return postures
