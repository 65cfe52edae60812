"""Taking and putting: the hand comes on a free way, touches, holds, carries, sets down and leaves."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.actions import other_stands
from embomatrix.sim.physical_fold import approach, fold, unfold
from embomatrix.sim.physical_grasp import grasp_tracks
from embomatrix.sim.physical_motion import raised
from embomatrix.sim.physical_reach import Track
from embomatrix.sim.physical_stage import TOOL
from embomatrix.sim.physical_travel import SOMETHING, travel
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import preposition, refuse
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.sim.physical_reach import Way
    from embomatrix.sim.physical_space import Boxes
    from embomatrix.sim.physical_stage import Grip, Stage
    from embomatrix.skills.syntax import PlaceRelation
    from embomatrix.skills.view import Refusal
    from embomatrix.world.geometry import Aabb, FloatArray

GENTLE: Final = 0.25
"""Share of full speed on the last centimetres."""
TOUCH_M: Final = 0.004
RAISE_M: Final = 0.06
ROOFED_RAISE_M: Final = 0.015
ROOF_M: Final = 1.0
"""Things with a roof lower than this over them are reached from the side."""
WAY_OUT_M: Final = 0.04
ROOM_M: Final = 0.45
"""From the base's centre to where the hand is before its way in."""
ATTEMPTS: Final = 3
WAYS: Final = 16
"""Ways that are looked at, and that are tried, before a skill gives up."""
PLACES: Final = 24
FITS: Final = 64
"""Turned poses that are looked at: those in the open first, then the less deep ones."""
DROP_M: Final = 0.004
"""The hand lets go when what it holds touches, or this far below where it should."""
LEVEL: Final = 0.3
"""A hand that points down more steeply than this has no heading."""
ASIDES: Final = (0.0, 35.0, -35.0)
"""Degrees by which the hand may come from aside when it puts something."""


def _bases(stage: Stage, pose: Pose, course: float, out_m: float | None) -> list[FloatArray]:
    """Where to stand to work at a pose: before the way in, far enough to hold the thing outside."""
    point = np.array(pose.position_m)
    return stage.bases(point) if out_m is None else stage.bases(point, out_m + ROOM_M, course)


def pick_up(stage: Stage, target: str, rng: np.random.Generator) -> Refusal | None:
    """Take an object that lies where the robot can reach it."""
    home = stage.world.robot
    refusal = _take(stage, target, rng)
    fold(stage, home, rng, target)
    if refusal is None and stage.has_slipped():
        refusal = refuse(FailureReason.SLIPPED, target=target)
    if refusal is not None and stage.grip is not None:
        stage.release()
        stage.settle()
    return refusal


def _take(stage: Stage, target: str, rng: np.random.Generator) -> Refusal | None:
    world = stage.world
    pose = world.engine.pose(target)
    boxes = stage.boxes()
    course, out_m = way_in(stage, target, world.engine.aabb(target), boxes)
    tracks = grasp_tracks(world.asset(target), pose, world.engine.joints(target), course, out_m)
    roofed = len(tracks) if out_m is not None else 0
    if roofed:
        # A roof may be high enough to come from above all the same: what is around decides.
        tracks += grasp_tracks(world.asset(target), pose, world.engine.joints(target), course, None)
    reach = stage.reach(boxes, target)
    refusal = None
    attempts = 0
    for way in itertools.islice(reach.ways(tracks, _bases(stage, pose, course, out_m)), WAYS):
        if attempts == ATTEMPTS:
            return refusal
        swing = approach(stage, way, reach, rng, loaded=False)
        if swing is None:
            continue
        attempts += 1
        refusal = unfold(stage, swing) or _touch(stage, way, target)
        if refusal is None:
            return _lift(stage, way, target, ROOFED_RAISE_M if way.track < roofed else RAISE_M)
        fold(stage, StandPose(*stage.mover.posture[:3].tolist()), rng)
    return refusal or refuse(FailureReason.ARM_BLOCKED, target=target, other=reach.hindrance or SOMETHING)


def _touch(stage: Stage, way: Way, target: str) -> Refusal | None:
    """Go along a way until the hand touches the target, and hold it."""
    stage.wake_around(target)
    hit = stage.mover.follow(way.postures[1:-2]) if len(way.postures) > 3 else None
    if hit is None:
        hit = stage.mover.follow(way.postures[-2:], GENTLE, lambda: stage.dynamic.gap(target) < TOUCH_M)
    if stage.dynamic.gap(target) > TOUCH_M * 2:
        return refuse(FailureReason.ARM_BLOCKED, target=target, other=hit or SOMETHING)
    stage.take(target)
    return None


def _lift(stage: Stage, way: Way, target: str, by_m: float) -> Refusal | None:
    """Raise what is held, with what lies in it, and go back along the way."""
    world = stage.world
    world.hand.take(world.cargo(target))
    world.navigator.refresh()
    hit = stage.mover.follow(raised(stage.mover.posture[None], by_m), 0.5)
    if hit is None:
        stage.mover.follow(raised(way.postures[-3::-1], by_m))
    if stage.has_slipped():
        stage.release()
        world.hand.let_go(stage.dynamic.pose(target))
        return refuse(FailureReason.SLIPPED, target=target)
    return None


def way_in(stage: Stage, name: str, box: Aabb, boxes: Boxes) -> tuple[float, float | None]:
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


def place(stage: Stage, target: str, asked: PlaceRelation, rng: np.random.Generator) -> Refusal | None:
    """Put what the hand holds where the planning scene has room for it, and see whether it stays."""
    world, grip = stage.world, stage.grip
    assert grip is not None
    home, held = world.robot, grip.name
    relation = Relation(asked.value)
    words = {"held": held, "target": target, "relation": preposition(asked)}
    found, stand = _places(stage, target, relation, rng)
    if isinstance(found, FailureReason):
        return refuse(found, **words)
    if stand is not home:
        refusal = travel(stage, stand, target)
        if refusal is not None:
            return refusal
        home = stand
    refusal = _put(stage, target, relation, found, rng)
    if stage.grip is not None:
        fold(stage, home, rng, target)
        return refusal
    fold(stage, home, rng, target)
    stage.settle()
    if refusal is None and not world.relations.holds(relation, held, target):
        return refuse(FailureReason.FELL, **words)
    return refusal


def _places(
    stage: Stage, target: str, relation: Relation, rng: np.random.Generator
) -> tuple[tuple[Pose, ...] | FailureReason, StandPose]:
    """Poses for what is held, or why there are none, and where to stand for them: as in cached mode, here if there are any."""
    world = stage.world
    held, here = world.carried[0], world.robot
    found = world.placer.choices(held, target, relation, here, rng, most=PLACES)
    if found is FailureReason.NO_FREE_POSE:
        for stand in other_stands(world, target):
            more = world.placer.choices(held, target, relation, stand, rng, most=PLACES)
            if not isinstance(more, FailureReason):
                return more, stand
    return found, here


def _put(
    stage: Stage, target: str, relation: Relation, poses: Sequence[Pose], rng: np.random.Generator
) -> Refusal | None:
    """Bring what is held to the first of several poses that the arm gets at, let go, and draw the hand back."""
    grip = stage.grip
    assert grip is not None
    boxes = stage.boxes()
    reach = stage.reach(boxes)
    attempts, refusal = 0, None
    # The first pose is where cached mode puts it: the others are for when the arm does not get there.
    for some in (poses[:1], poses[1:]):
        fits = _turned(stage, target, relation, some, boxes)[:FITS]
        tracks = list(_put_tracks(grip, fits))
        ways = reach.ways(tracks, _bases(stage, *fits[0])) if fits else iter(())
        for way in itertools.islice(ways, WAYS):
            if attempts == ATTEMPTS:
                return refusal
            swing = approach(stage, way, reach, rng, loaded=True)
            if swing is None:
                continue
            attempts += 1
            refusal = unfold(stage, swing)
            if refusal is None:
                return _set_down(stage, way, tracks[way.track])
    name = grip.name
    return refusal or refuse(
        FailureReason.ARM_BLOCKED, target=f"a place for {name}", other=reach.hindrance or target
    )


def _turned(
    stage: Stage, target: str, relation: Relation, poses: Sequence[Pose], boxes: Boxes
) -> list[tuple[Pose, float, float | None]]:
    """Each pose turned about the vertical so that the hand can come the way in, as far as there is room; then as it is.

    With the pose, the heading of the way in and its length under a roof.
    """
    grip = stage.grip
    assert grip is not None
    world = stage.world
    fits: list[tuple[Pose, float, float | None]] = []
    for pose in poses:
        world.engine.set_pose(grip.name, pose)
        course, out_m = way_in(stage, grip.name, world.engine.aabb(grip.name), boxes)
        pointing = (pose @ grip.pose_tool_object.inverse()).rotation[:, 2]
        if math.hypot(pointing[0], pointing[1]) > LEVEL:
            present = math.atan2(pointing[1], pointing[0])
            turns = [math.remainder(course + math.radians(aside) - present, math.tau) for aside in ASIDES]
        else:
            turns = [0.0, math.pi / 2]
        for turn in turns:
            about = Pose.from_xyz_yaw(0.0, 0.0, 0.0, turn) @ Pose((0.0, 0.0, 0.0), pose.quat_xyzw)
            turned = Pose(pose.position_m, about.quat_xyzw)
            world.engine.set_pose(grip.name, turned)
            if not world.engine.penetrates(grip.name) and world.relations.holds(relation, grip.name, target):
                fits.append((turned, course, out_m))
        fits.append((pose, course, out_m))
    world.engine.park(grip.name)
    fits.sort(key=lambda fit: fit[2] or 0.0)
    return fits + [(pose, course, None) for pose, course, out_m in fits if out_m is not None]


def _put_tracks(grip: Grip, fits: Sequence[tuple[Pose, float, float | None]]) -> Iterator[Track]:
    """Ways that bring what is held to a pose and the empty hand back from there: in, down, and out."""
    back = grip.pose_tool_object.inverse()
    for pose, course, out_m in fits:
        tool = pose @ back
        rotation, point = tool.rotation, np.array(tool.position_m)
        inward = np.array([math.cos(course), math.sin(course), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        if out_m is None:
            before = [point + 0.12 * up, point + 0.05 * up]
            after = [point - 0.05 * rotation[:, 2] + 0.01 * up, point - 0.1 * rotation[:, 2] + 0.03 * up]
        else:
            count = max(2, math.ceil(out_m / 0.12) + 1)
            steps = np.linspace(out_m, 0.0, count)[:, None]
            before = list(point + ROOFED_RAISE_M * up - steps * inward)
            off = point - 0.04 * rotation[:, 2] + 0.012 * up
            after = [off, *(off - steps[::-1][1:] * inward)]
        positions = np.array([*before, point, *after])
        loaded = np.arange(len(positions)) < len(before)
        yield Track(np.tile(rotation, (len(positions), 1, 1)), positions, loaded, len(before))


def _set_down(stage: Stage, way: Way, track: Track) -> Refusal | None:
    """Follow a way down to where the thing touches, let go, and follow it out."""
    grip, world = stage.grip, stage.world
    assert grip is not None
    name = grip.name
    key = track.key
    hit = stage.mover.follow(way.postures[1:key])
    if hit is not None or stage.has_slipped():
        reason = FailureReason.SLIPPED if stage.has_slipped() else FailureReason.ARM_BLOCKED
        return refuse(reason, target=name, other=hit or SOMETHING)
    lower = raised(way.postures[key], -DROP_M)
    ignore = frozenset(world.carried)
    stage.mover.follow(
        np.stack([way.postures[key], lower]), GENTLE, lambda: bool(stage.dynamic.touched_by(name, ignore))
    )
    stage.release()
    stage.mover.wait(16)
    let_go(stage)
    stage.mover.follow(way.postures[key + 1 :], 0.5)
    return None


def let_go(stage: Stage) -> None:
    """Put what the hand held, and what lay in it, into the planning scene where it now is."""
    world = stage.world
    group = world.carried
    world.hand.forget()
    for name in group:
        world.engine.set_pose(name, stage.dynamic.pose(name))
    world.navigator.refresh()


def tool_pose(stage: Stage) -> Pose:
    """The tool's frame in the world."""
    return stage.dynamic.robot.hand_pose() @ TOOL
