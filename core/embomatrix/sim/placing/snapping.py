"""Grid of stored poses: places move by less than 0.4 mm and rotations by at most 0.01 rad, so that a dataset compresses well.

The lowest digits of a settled pose are noise of the simulator. Without them, the poses of a dataset take a third of the bytes.
"""

import math
from typing import Final

from embomatrix.world.geometry import Pose

ACROSS_M: Final = 2.0**-11
"""Step of x and y. Powers of two leave the lowest bits of the numbers zero."""
UP_M: Final = 2.0**-13
"""Step of z."""
TILT_RAD: Final = 2e-3
"""Largest tilt to remove."""
TURN_RAD: Final = 1e-2
"""Largest rotation about z to a multiple of a quarter turn."""
_HALF: Final = math.sqrt(0.5)
_QUARTERS: Final = (
    (0.0, 0.0, 0.0, 1.0),
    (0.0, 0.0, _HALF, _HALF),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, _HALF, -_HALF),
)
"""Quaternions of rotations by multiples of a quarter turn about z."""


def snapped(pose: Pose) -> Pose:
    """Return the pose on the grid next to a settled pose, at its height or above.

    A pose that is nearly upright at a multiple of a quarter turn becomes exactly so. Others keep their rotation.
    """
    x, y, z = pose.position_m
    place = (_nearest(x, ACROSS_M), _nearest(y, ACROSS_M), math.ceil(z / UP_M) * UP_M)
    qx, qy, qz, qw = pose.quat_xyzw
    turn = 2 * math.atan2(qz, qw)
    quarter = round(turn / (math.pi / 2))
    if 2 * math.hypot(qx, qy) > TILT_RAD or abs(turn - quarter * math.pi / 2) > TURN_RAD:
        return Pose(place, pose.quat_xyzw)
    return Pose(place, _QUARTERS[quarter % 4])


def _nearest(value: float, step: float) -> float:
    return round(value / step) * step
