"""Dimensions of the robot below its arm, shared by its description, its kinematics and its collision model.

A flat round base carries a mast of two stages. A carriage runs on the mast, and the arm is bolted to it sideways: the arm's
first axis is level, and the shoulder is at the carriage's height, from shin to above shoulder height of a tall person. Mast
and arm are rotated on the base: with the first axis straight ahead, most work would be near the singular postures in which the
first and third joints turn about one line.

Frames: x along the arm's first axis, y left of it, z up, from the base's centre on the floor.
"""

from typing import Final

BASE_RADIUS_M: Final = 0.25
BASE_TOP_M: Final = 0.18
GROUND_M: Final = 0.035
"""Ground clearance: the base passes over rugs up to this height."""
MAST_X_M: Final = -0.195
"""Middle of the mast."""
MAST_SIZE_M: Final = (0.05, 0.14)
MAST_TOP_M: Final = 1.25
"""Height of both stages with the carriage down."""
STAGE_SHARE: Final = 0.24
"""Share of the carriage's travel that the inner stage rises."""
MOUNT_X_M: Final = -0.15
"""End of the carriage and start of the arm's foot."""
SHOULDER_LOW_M: Final = 0.29
"""Height of the shoulder with the carriage down: the arm's foot is just over the base."""
ASKEW_RAD: Final = 0.7853981633974483
"""Angle of the arm's first axis to the left of the robot's front."""
LIFT_M: Final = 1.25
"""Travel of the carriage."""
CARRIAGE_SIZE_M: Final = (0.02, 0.18, 0.19)
MOUNT_AXES: Final = ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
"""Rotation of the arm's mount, by rows: z is the first axis, x points to its right, y points down."""
MOUNT_RPY: Final = (-1.5707963267948966, 0.0, -1.5707963267948966)
"""Roll, pitch and yaw of the mount about fixed axes."""
