"""Whether the arm gets at a thing: its distance and height, what stands between, and closed containers around it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.skills.view import metres, refuse

if TYPE_CHECKING:
    from embomatrix.skills.view import SkillRefusal, WorldView


def out_of_reach(world: WorldView, name: str) -> SkillRefusal | None:
    """Refusal when the object is too high or too far away."""
    reach = world.reach(name)
    if reach.height_m > ROBOT.reach_high_m:
        return refuse(
            FailureReason.TOO_HIGH,
            target=name,
            height=metres(reach.height_m),
            limit=metres(ROBOT.reach_high_m),
        )
    if reach.distance_m > ROBOT.reach_m:
        return refuse(
            FailureReason.OUT_OF_REACH,
            target=name,
            distance=metres(reach.distance_m),
            limit=metres(ROBOT.reach_m),
        )
    return None


def hidden(world: WorldView, name: str) -> SkillRefusal | None:
    """Refusal when a wall or furniture lies between the robot and the object."""
    return None if world.is_approachable(name) else refuse(FailureReason.NO_LINE_OF_APPROACH, target=name)


def shut_in(world: WorldView, name: str) -> SkillRefusal | None:
    """Refusal when a closed container is around the object."""
    container = world.closed_around(name)
    return refuse(FailureReason.CONTAINER_CLOSED, container=container) if container else None
