"""Picking up: the hand approaches on a free path, touches, grips and lifts."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from embomatrix.sim.physical.fold import ATTEMPTS, arrivals, fold
from embomatrix.sim.physical.grasp import grasp_tool_paths
from embomatrix.sim.physical.motion import raised
from embomatrix.sim.physical.reach import ArmPath, ToolPath
from embomatrix.sim.physical.space import Boxes
from embomatrix.sim.physical.stage import PhysicalStage
from embomatrix.sim.physical.travel import SOMETHING
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import SkillRefusal, refuse
from embomatrix.world.geometry import Aabb, FloatArray, Pose
from embomatrix.world.poses import StandPose

GENTLE_PACE: Final = 0.25
"""Share of full speed on the last centimetres."""
TOUCH_M: Final = 0.004
PUSHED_M: Final = 0.01
RAISE_M: Final = 0.06
ROOFED_RAISE_M: Final = 0.015
ROOF_M: Final = 1.0
"""Objects with a roof lower than this above them are reached from the side."""
CLEARANCE_M: Final = 0.04
ROOM_M: Final = 0.45
"""Distance from the centre of the base to the hand before its entry."""


def bases_at(stage: PhysicalStage, pose: Pose, course: float, depth_m: float | None) -> list[FloatArray]:
    """Return standing places for work at a pose, far enough from an entry to hold the object outside."""
    point = np.array(pose.position_m)
    return stage.bases(point) if depth_m is None else stage.bases(point, depth_m + ROOM_M, course)


def pick_up(stage: PhysicalStage, target: str) -> SkillRefusal | None:
    """Pick up an object in reach."""
    home = stage.commanded
    for _ in range(ATTEMPTS):
        refusal = take_by(stage, target, *pick_paths(stage, target))
        if refusal is None or not _was_pushed(stage, target):
            break
        stage.settle()
    fold(stage, home, target)
    if refusal is None and stage.has_slipped():
        refusal = refuse(FailureReason.SLIPPED, target=target)
    if refusal is not None and stage.grip is not None:
        stage.drop()
    return refusal


def _was_pushed(stage: PhysicalStage, name: str) -> bool:
    """True if an object was moved, so that the planned paths miss it."""
    now, then = stage.dynamic.bodies.pose(name), stage.world.engine.pose(name)
    return stage.grip is None and math.dist(now.position_m, then.position_m) > PUSHED_M


def pick_paths(stage: PhysicalStage, target: str) -> tuple[list[ToolPath], int, list[FloatArray]]:
    """Return tool paths to an object, the number of the first ones that enter under a roof, and bases, (b, 3), for them."""
    world = stage.world
    pose, joints = world.engine.pose(target), world.engine.joints(target)
    course, depth_m = entry(stage, target, world.engine.aabb(target), stage.boxes())
    tool_paths = grasp_tool_paths(world.asset(target), pose, joints, course, depth_m)
    roofed = len(tool_paths) if depth_m is not None else 0
    if roofed:
        # A roof may be high enough for a hand from above: the obstacles decide.
        tool_paths += grasp_tool_paths(world.asset(target), pose, joints, course, None)
    return tool_paths, roofed, bases_at(stage, pose, course, depth_m)


def take_by(
    stage: PhysicalStage,
    target: str,
    tool_paths: Sequence[ToolPath],
    roofed: int,
    bases: Sequence[FloatArray],
) -> SkillRefusal | None:
    """Pick up an object on a tool path from one of the bases, (b, 3). The first ``roofed`` ones enter under a roof."""
    reach = stage.reach(stage.boxes(), target)
    refusal = None
    for path, lost in arrivals(stage, reach.paths(tool_paths, bases), reach, loaded=False):
        refusal = lost or _touch(stage, path, target)
        if refusal is None:
            return _lift(stage, path, target, ROOFED_RAISE_M if path.number < roofed else RAISE_M)
        fold(stage, StandPose(*stage.mover.posture[:3].tolist()))
        if _was_pushed(stage, target):
            return refusal
    return refusal or refuse(FailureReason.ARM_BLOCKED, target=target, other=reach.blocker or SOMETHING)


def _touch(stage: PhysicalStage, path: ArmPath, target: str) -> SkillRefusal | None:
    """Follow a path until the hand touches the target, and grip it."""
    stage.wake_around(stage.world.engine.aabb(target))
    hit = stage.mover.advance(path.postures[1:-2]) if len(path.postures) > 3 else None
    if hit is None:
        hit = stage.mover.follow(path.postures[-2:], GENTLE_PACE, lambda: stage.dynamic.gap(target) < TOUCH_M)
    if stage.dynamic.gap(target) > TOUCH_M * 2:
        return refuse(FailureReason.ARM_BLOCKED, target=target, other=hit or SOMETHING)
    stage.take(target)
    return None


def _lift(stage: PhysicalStage, path: ArmPath, target: str, by_m: float) -> SkillRefusal | None:
    """Raise the gripped object with its contents, and go back along the path."""
    world = stage.world
    world.hand.take(world.cargo(target))
    world.navigator.refresh()
    hit = stage.mover.follow(raised(stage.mover.posture[None], by_m), 0.5)
    if hit is None:
        stage.mover.advance(raised(path.postures[-3::-1], by_m))
    if stage.has_slipped():
        stage.drop()
        return refuse(FailureReason.SLIPPED, target=target)
    return None


def entry(stage: PhysicalStage, name: str, box: Aabb, boxes: Boxes) -> tuple[float, float | None]:
    """Return the hand's heading at a place, and the length of its way under a roof; None for the length in the open.

    Under a roof the hand enters through the front of the furniture that the object is in or on. Under other furniture it enters
    from the side of the robot.
    """
    robot, engine = stage.world.robot, stage.world.engine
    x, y, _ = box.center_m
    course = math.atan2(y - robot.y_m, x - robot.x_m)
    low = np.array([x - 0.01, y - 0.01, box.high_m[2] + 0.002])
    over = boxes.without((name,)).near(low, low + np.array([0.02, 0.02, ROOF_M]))
    hosts = [
        owner for owner in over.owners if owner in stage.world.scene.by_name and stage.world.is_fixed(owner)
    ]
    if not hosts:
        return course, None
    own = stage.world.relations.hosts_of(name)
    host = next((owner for owner in hosts if owner in own), hosts[0])
    side = engine.pose(host).yaw
    if host not in own:
        # Use the nearest of its four sides, in quarter turns from its front.
        side += round(math.remainder(course + math.pi - side, math.tau) / (math.pi / 2)) * math.pi / 2
    front = math.remainder(side + math.pi, math.tau)
    bounds = stage.world.relations.body(host)
    ahead = np.array([math.cos(side), math.sin(side)])
    half = np.abs(ahead) @ (np.array(bounds.size_m[:2]) / 2)
    depth = float(ahead @ (np.array(bounds.center_m[:2]) - (x, y)) + half)
    extent = np.array(box.size_m[:2])
    return front, max(0.05, depth) + float(np.abs(ahead) @ extent) / 2 + CLEARANCE_M
