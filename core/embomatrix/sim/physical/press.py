"""Touching: the hand presses switches and works on objects."""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from embomatrix.sim.physical import arm, body
from embomatrix.sim.physical.fold import arrivals, fold
from embomatrix.sim.physical.grasp import facing, surface_point
from embomatrix.sim.physical.pick import GENTLE_PACE, TOUCH_M
from embomatrix.sim.physical.reach import ArmPath, ArmReach, ToolPath
from embomatrix.sim.physical.space import collides, part_boxes
from embomatrix.sim.physical.stage import PhysicalStage
from embomatrix.sim.physical.travel import SOMETHING
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import SkillRefusal, refuse
from embomatrix.world.geometry import FloatArray

HEIGHTS: Final = (0.85, 0.97, 0.65, 0.45, 0.25)
"""Shares of the object's height at which the hand presses, in order of preference."""
DOWNS: Final = (0.0, 35.0, 70.0, 90.0)
ASIDES: Final = (0.0, 30.0, -30.0)
OFF_M: Final = 0.08
BEYOND_M: Final = 0.02


def press(stage: PhysicalStage, target: str) -> SkillRefusal | None:
    """Touch an object with the empty hand."""
    home = stage.commanded
    refusal = _press(stage, target)
    fold(stage, home, target)
    return refusal


def _press(stage: PhysicalStage, target: str) -> SkillRefusal | None:
    reach, paths = press_paths(stage, target)
    refusal = None
    for path, refusal in arrivals(stage, paths, reach, loaded=False):
        if refusal is not None:
            continue
        if not stage.world.is_fixed(target):
            stage.wake_around(stage.world.engine.aabb(target))
        hit = stage.mover.follow(path.postures[1:3], GENTLE_PACE, lambda: stage.dynamic.gap(target) < TOUCH_M)
        touched = stage.dynamic.gap(target) < 2 * TOUCH_M
        stage.mover.follow(path.postures[:1])
        if touched:
            return None
        refusal = refuse(FailureReason.ARM_BLOCKED, target=target, other=hit or SOMETHING)
    return refusal or refuse(FailureReason.ARM_BLOCKED, target=target, other=reach.blocker or SOMETHING)


def press_paths(stage: PhysicalStage, target: str) -> tuple[ArmReach, Iterator[ArmPath]]:
    """Return free paths that touch an object, and the reach that judges them.

    Only the hand may touch it: an arm that leans on the object would keep the hand off.
    """
    boxes = stage.boxes()
    own = boxes.only(target)

    def leans_not(postures: FloatArray) -> bool:
        return not collides(own, *body.forearm_balls(postures), 0.0).any()

    reach = stage.reach(boxes, target, leans_not)
    point = np.array(stage.world.relations.body(target).center_m)
    return reach, reach.paths(_tool_paths(stage, target), stage.bases(point))


def _tool_paths(stage: PhysicalStage, target: str) -> Iterator[ToolPath]:
    """Yield tool paths to the side that faces the robot, from the usual height of a switch downwards."""
    world = stage.world
    robot = world.robot
    boxes = part_boxes(world.asset(target), world.engine.pose(target), world.engine.joints(target))
    box = world.relations.body(target)
    low, high = np.array(box.low_m), np.array(box.high_m)
    nearest = np.clip((robot.x_m, robot.y_m), low[:2] + 0.03, np.maximum(high[:2] - 0.03, low[:2] + 0.03))
    middle = np.array(box.center_m[:2])
    for height in HEIGHTS:
        z = low[2] + height * (high[2] - low[2])
        for x, y in (nearest, 0.5 * (nearest + middle), middle):
            course = math.atan2(y - robot.y_m, x - robot.x_m)
            for aside in ASIDES:
                for down in DOWNS:
                    level = math.cos(math.radians(down))
                    heading = course + math.radians(aside)
                    into = np.array(
                        [math.cos(heading) * level, math.sin(heading) * level, -math.sin(math.radians(down))]
                    )
                    met = surface_point(boxes, np.array([x, y, z]), into)
                    if met is None:
                        continue
                    point = met[0]
                    rotation = facing(into, 0.0, arm.about_z(np.array([course]))[0][:, 1])
                    positions = np.array([point - OFF_M * into, point - 0.01 * into, point + BEYOND_M * into])
                    yield ToolPath(np.tile(rotation, (3, 1, 1)), positions, np.zeros(3, dtype=bool), 1)
