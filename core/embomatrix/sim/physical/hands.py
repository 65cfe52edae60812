"""Taking: the hand comes on a free way, touches, holds and lifts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.physical.fold import ATTEMPTS, arrivals, fold
from embomatrix.sim.physical.grasp import grasp_tracks
from embomatrix.sim.physical.motion import raised
from embomatrix.sim.physical.travel import SOMETHING
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import refuse
from embomatrix.world.poses import StandPose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.sim.physical.reach import Track, Way
    from embomatrix.sim.physical.space import Boxes
    from embomatrix.sim.physical.stage import PhysicalStage
    from embomatrix.skills.view import SkillRefusal
    from embomatrix.world.geometry import Aabb, FloatArray, Pose

GENTLE: Final = 0.25
"""Share of full speed on the last centimetres."""
TOUCH_M: Final = 0.004
PUSHED_M: Final = 0.01
RAISE_M: Final = 0.06
ROOFED_RAISE_M: Final = 0.015
ROOF_M: Final = 1.0
"""Things with a roof lower than this over them are reached from the side."""
WAY_OUT_M: Final = 0.04
ROOM_M: Final = 0.45
"""From the base's centre to where the hand is before its way in."""


def bases_at(stage: PhysicalStage, pose: Pose, course: float, out_m: float | None) -> list[FloatArray]:
    """Where to stand to work at a pose: before the way in, far enough to hold the thing outside."""
    point = np.array(pose.position_m)
    return stage.bases(point) if out_m is None else stage.bases(point, out_m + ROOM_M, course)


def pick_up(stage: PhysicalStage, target: str) -> SkillRefusal | None:
    """Take an object that lies where the robot can reach it."""
    home = stage.told
    for _ in range(ATTEMPTS):
        refusal = _take(stage, target)
        if refusal is None or not _was_pushed(stage, target):
            break
        stage.settle()
    fold(stage, home, target)
    if refusal is None and stage.has_slipped():
        refusal = refuse(FailureReason.SLIPPED, target=target)
    if refusal is not None and stage.grip is not None:
        stage.release()
        stage.settle()
    return refusal


def _was_pushed(stage: PhysicalStage, name: str) -> bool:
    """Whether an object is not where the planning scene has it, so that ways to it lead past it."""
    now, then = stage.dynamic.bodies.pose(name), stage.world.engine.pose(name)
    return stage.grip is None and math.dist(now.position_m, then.position_m) > PUSHED_M


def _take(stage: PhysicalStage, target: str) -> SkillRefusal | None:
    tracks, roofed, bases = ways_to(stage, target)
    return take_by(stage, target, tracks, roofed, bases)


def ways_to(stage: PhysicalStage, target: str) -> tuple[list[Track], int, list[FloatArray]]:
    """Ways of the tool to an object, how many of the first lead in under a roof, and bases, (b, 3), to go them from."""
    world = stage.world
    pose, joints = world.engine.pose(target), world.engine.joints(target)
    course, out_m = way_in(stage, target, world.engine.aabb(target), stage.boxes())
    tracks = grasp_tracks(world.asset(target), pose, joints, course, out_m)
    roofed = len(tracks) if out_m is not None else 0
    if roofed:
        # A roof may be high enough to come from above all the same: what is around decides.
        tracks += grasp_tracks(world.asset(target), pose, joints, course, None)
    return tracks, roofed, bases_at(stage, pose, course, out_m)


def take_by(
    stage: PhysicalStage,
    target: str,
    tracks: Sequence[Track],
    roofed: int,
    bases: Sequence[FloatArray],
) -> SkillRefusal | None:
    """Take an object on any of some ways, the first ``roofed`` of which lead in under a roof, from any of the bases, (b, 3)."""
    reach = stage.reach(stage.boxes(), target)
    refusal = None
    for way, lost in arrivals(stage, reach.ways(tracks, bases), reach, loaded=False):
        refusal = lost or _touch(stage, way, target)
        if refusal is None:
            return _lift(stage, way, target, ROOFED_RAISE_M if way.number < roofed else RAISE_M)
        fold(stage, StandPose(*stage.mover.posture[:3].tolist()))
        if _was_pushed(stage, target):
            return refusal
    return refusal or refuse(FailureReason.ARM_BLOCKED, target=target, other=reach.hindrance or SOMETHING)


def _touch(stage: PhysicalStage, way: Way, target: str) -> SkillRefusal | None:
    """Go along a way until the hand touches the target, and hold it."""
    stage.wake_around(stage.world.engine.aabb(target))
    hit = stage.mover.advance(way.postures[1:-2]) if len(way.postures) > 3 else None
    if hit is None:
        hit = stage.mover.follow(way.postures[-2:], GENTLE, lambda: stage.dynamic.gap(target) < TOUCH_M)
    if stage.dynamic.gap(target) > TOUCH_M * 2:
        return refuse(FailureReason.ARM_BLOCKED, target=target, other=hit or SOMETHING)
    stage.take(target)
    return None


def _lift(stage: PhysicalStage, way: Way, target: str, by_m: float) -> SkillRefusal | None:
    """Raise what is held, with what lies in it, and go back along the way."""
    world = stage.world
    world.hand.take(world.cargo(target))
    world.navigator.refresh()
    hit = stage.mover.follow(raised(stage.mover.posture[None], by_m), 0.5)
    if hit is None:
        stage.mover.advance(raised(way.postures[-3::-1], by_m))
    if stage.has_slipped():
        stage.release()
        world.hand.let_go(stage.dynamic.bodies.pose(target))
        return refuse(FailureReason.SLIPPED, target=target)
    return None


def way_in(stage: PhysicalStage, name: str, box: Aabb, boxes: Boxes) -> tuple[float, float | None]:
    """Heading in which the hand goes to a place, and how long its way under a roof is; None in the open.

    Under a roof the way follows the front of what roofs the place over, when the thing is in or on that; what hangs over
    another thing is entered from the side where the robot is.
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
        # The nearest of its four sides: a quarter turn counts from its front.
        side += round(math.remainder(course + math.pi - side, math.tau) / (math.pi / 2)) * math.pi / 2
    front = math.remainder(side + math.pi, math.tau)
    bounds = stage.world.relations.body(host)
    ahead = np.array([math.cos(side), math.sin(side)])
    half = np.abs(ahead) @ (np.array(bounds.size_m[:2]) / 2)
    depth = float(ahead @ (np.array(bounds.center_m[:2]) - (x, y)) + half)
    extent = np.array(box.size_m[:2])
    return front, max(0.05, depth) + float(np.abs(ahead) @ extent) / 2 + WAY_OUT_M
