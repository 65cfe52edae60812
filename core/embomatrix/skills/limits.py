"""Limits of the robot: one table for both execution modes."""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class RobotLimits:
    """Limits of a mobile manipulator with a round holonomic base, a lifting torso and one arm."""

    radius_m: float = 0.27
    """Radius of the base, and of the free disc that it needs on the floor."""
    height_m: float = 1.4
    """Obstacles whose underside is higher than this do not block the robot."""
    shoulder_m: float = 0.35
    """Least distance of a standing pose, at the centre of the base, from the nearest edge of the object that it serves."""
    reach_m: float = 1.10
    """Largest horizontal distance from the centre of the base to the nearest point of the object in use."""
    reach_high_m: float = 2.0
    reach_low_m: float = 0.0
    """Highest and lowest working height of the gripper."""
    mass_kg: float = 8.0
    grip_m: float = 0.30
    """Largest allowed smallest extent of a portable object."""
    extent_m: float = 0.90
    """Largest allowed extent of a portable object."""
    max_step_m: float = 5.0
    """Longest ``move_forward``."""


ROBOT: Final = RobotLimits()
