"""What the robot can do: one table, kept by both execution modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class RobotLimits:
    """A mobile manipulator on a round holonomic base with a lifting torso and one arm."""

    radius_m: float = 0.27
    """Radius of the base: the free disc that it needs on the floor."""
    height_m: float = 1.4
    """Obstacles whose underside is higher than this don't bar the way."""
    shoulder_m: float = 0.35
    """A standing pose is at least this far from the nearest edge of what it serves, measured from the base's centre."""
    reach_m: float = 1.10
    """Horizontal distance from the base's centre to the nearest point of what is grasped, pressed or pulled."""
    reach_high_m: float = 2.0
    reach_low_m: float = 0.0
    """Heights between which the gripper works."""
    mass_kg: float = 8.0
    grip_m: float = 0.30
    """The smallest extent of a thing that can be picked up is at most this."""
    extent_m: float = 0.90
    """No extent of a thing that can be picked up is larger."""
    max_step_m: float = 5.0
    """The longest ``move_forward``."""


ROBOT: Final = RobotLimits()
