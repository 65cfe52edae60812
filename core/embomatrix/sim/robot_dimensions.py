"""Dimensions of the robot below its arm: one table for its description, for its kinematics and for what it strikes.

A flat round base carries a mast of two stages. A carriage runs on the mast, and the arm is bolted to it sideways: the arm's
first axis is level, so its shoulder is as high as the carriage, from a shin's height to over a tall person's shoulder. Mast
and arm stand askew on the base: with the first axis straight ahead the arm would be near its singular postures, where its
first and third joints turn about one line, just where most of its work is.

Frames: x along the arm's first axis, y left of it, z up, from the base's centre on the floor.
"""

from __future__ import annotations

from typing import Final

BASE_RADIUS_M: Final = 0.25
BASE_TOP_M: Final = 0.18
GROUND_M: Final = 0.035
"""The base passes over rugs up to this height."""
MAST_X_M: Final = -0.195
"""Middle of the mast."""
MAST_SIZE_M: Final = (0.05, 0.14)
MAST_TOP_M: Final = 1.25
"""Height of both stages with the carriage down."""
STAGE_SHARE: Final = 0.24
"""The inner stage rises by this share of the carriage's travel."""
MOUNT_X_M: Final = -0.15
"""Where the carriage ends and the arm's foot begins."""
SHOULDER_LOW_M: Final = 0.29
"""Height of the shoulder with the carriage down: the arm's foot is just over the base."""
ASKEW_RAD: Final = 0.7853981633974483
"""The arm's first axis points this far to the left of where the robot faces."""
LIFT_M: Final = 1.25
"""Travel of the carriage."""
CARRIAGE_SIZE_M: Final = (0.02, 0.18, 0.19)
MOUNT_AXES: Final = ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
"""Rotation of the arm's mount, by rows: its z is the first axis, its x points to the right of that, its y down."""
MOUNT_RPY: Final = (-1.5707963267948966, 0.0, -1.5707963267948966)
"""The same as roll, pitch and yaw, about fixed axes."""
