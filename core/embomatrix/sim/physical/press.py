"""Touching: switches are pressed and things are worked on where the hand, or what it holds, gets at them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.physical import arm, body
from embomatrix.sim.physical.fold import arrivals, fold
from embomatrix.sim.physical.grasp import facing, surface_point
from embomatrix.sim.physical.hands import GENTLE, TOUCH_M
from embomatrix.sim.physical.reach import Track
from embomatrix.sim.physical.space import part_boxes, struck
from embomatrix.sim.physical.travel import SOMETHING
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import refuse

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.sim.physical.reach import ArmReach, Way
    from embomatrix.sim.physical.stage import PhysicalStage
    from embomatrix.skills.view import SkillRefusal
    from embomatrix.world.geometry import FloatArray

HEIGHTS: Final = (0.85, 0.97, 0.65, 0.45, 0.25)
"""Shares of the thing's height at which it is pressed, the first that the arm reaches."""
DOWNS: Final = (0.0, 35.0, 70.0, 90.0)
ASIDES: Final = (0.0, 30.0, -30.0)
OFF_M: Final = 0.08
BEYOND_M: Final = 0.02


def press(stage: PhysicalStage, target: str) -> SkillRefusal | None:
    """Touch a thing with the empty hand."""
    home = stage.told
    refusal = _press(stage, target)
    fold(stage, home, target)
    return refusal


def _press(stage: PhysicalStage, target: str) -> SkillRefusal | None:
    reach, ways = pressing(stage, target)
    refusal = None
    for way, refusal in arrivals(stage, ways, reach, loaded=False):
        if refusal is not None:
            continue
        if not stage.world.is_fixed(target):
            stage.wake_around(stage.world.engine.aabb(target))
        hit = stage.mover.follow(way.postures[1:3], GENTLE, lambda: stage.dynamic.gap(target) < TOUCH_M)
        touched = stage.dynamic.gap(target) < 2 * TOUCH_M
        stage.mover.follow(way.postures[:1])
        if touched:
            return None
        refusal = refuse(FailureReason.ARM_BLOCKED, target=target, other=hit or SOMETHING)
    return refusal or refuse(FailureReason.ARM_BLOCKED, target=target, other=reach.hindrance or SOMETHING)


def pressing(stage: PhysicalStage, target: str) -> tuple[ArmReach, Iterator[Way]]:
    """Free ways to touch a thing, and what judges them.

    Nothing but the hand may meet it: an arm that leant on it would keep the hand off.
    """
    boxes = stage.boxes()
    own = boxes.only(target)

    def leans_not(postures: FloatArray) -> bool:
        return not struck(own, *body.forearm_balls(postures), 0.0).any()

    reach = stage.reach(boxes, target, leans_not)
    point = np.array(stage.world.relations.body(target).center_m)
    return reach, reach.ways(_tracks(stage, target), stage.bases(point))


def _tracks(stage: PhysicalStage, target: str) -> Iterator[Track]:
    """Ways to the side that faces the robot, from the switch's usual height on downwards."""
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
                    yield Track(np.tile(rotation, (3, 1, 1)), positions, np.zeros(3, dtype=bool), 1)
