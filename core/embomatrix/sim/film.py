"""Films: frames of a scene during a plan, as data for a renderer.

Cached mode has no motion between two states, so the film interpolates: the robot follows its path and carries objects before
its chest. The frames show outcomes; real motions come from physical mode.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bullet.robot import Posture
from embomatrix.skills.syntax import Plan
from embomatrix.skills.trace import Step
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.live_world import LiveWorld

FRAMES_PER_S: Final = 8
DRIVE_M_S: Final = 1.2
TURN_RAD_S: Final = 2.5
REACH_FRAMES: Final = 5
REST_FRAMES: Final = 3
"""Frames of a hand's movement, and of the pause after it."""
HAND_AHEAD_M: Final = 0.45
HAND_HIGH_M: Final = 0.95
"""Position of a carried object relative to the robot's base."""


@dataclass(frozen=True, slots=True)
class FilmFrame:
    """Frame of a film.

    ``poses`` and ``joints`` hold every object that differs from the scene's start, ``hidden`` those outside the world.
    ``robot`` is the base on the floor; ``posture`` all joints of the robot, None in cached mode. ``step`` counts the plan's
    calls from 1; 0 precedes the first.
    """

    robot: StandPose
    step: int
    poses: Mapping[str, Pose] = field(default_factory=dict)
    joints: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    hidden: frozenset[str] = frozenset()
    posture: Posture | None = None


@dataclass(frozen=True, slots=True)
class Film:
    """Frames of a plan at ``FRAMES_PER_S``, and its steps."""

    scene: Scene
    task: Task
    plan: Plan
    steps: tuple[Step, ...]
    frames: tuple[FilmFrame, ...]


def film_cached(simulator: Simulator, task: Task, plan: Plan, seed: int) -> Film:
    """Execute a plan in cached mode to its end or first failed step, and film it."""
    simulator.reset(task, seed)
    world = simulator.world
    shown = snapshot(world, 0)
    frames, steps = [shown] * REST_FRAMES, []
    for number, call in enumerate(plan, start=1):
        step = simulator.run_step(call)
        after = snapshot(world, number)
        frames += _between(world, shown, after)
        frames += [after] * REST_FRAMES
        steps.append(step)
        shown = after
        if not step.ok:
            frames += [after] * REST_FRAMES
            break
    return Film(world.scene, task, plan, tuple(steps), tuple(frames))


def snapshot(world: LiveWorld, step: int) -> FilmFrame:
    """Frame of a world's state, with the carried objects before the robot's chest."""
    engine = world.engine
    poses: dict[str, Pose] = {}
    joints: dict[str, tuple[float, ...]] = {}
    hidden: set[str] = set()
    for item in world.scene.objects:
        if engine.is_parked(item.name):
            hidden.add(item.name)
            continue
        pose, fractions = engine.pose(item.name), engine.joints(item.name)
        if pose != item.pose_world_asset or item.absent:
            poses[item.name] = pose
        if fractions != tuple(item.joints):
            joints[item.name] = fractions
    for name, offset in world.hand.offsets.items():
        poses[name] = hand_pose(world.robot) @ offset
        hidden.discard(name)
    return FilmFrame(world.robot, step, poses, joints, frozenset(hidden))


def hand_pose(robot: StandPose) -> Pose:
    """Pose of a carried object in a film."""
    x = robot.x_m + HAND_AHEAD_M * math.cos(robot.yaw)
    y = robot.y_m + HAND_AHEAD_M * math.sin(robot.yaw)
    return Pose.from_xyz_yaw(x, y, HAND_HIGH_M, robot.yaw)


def _between(world: LiveWorld, before: FilmFrame, after: FilmFrame) -> Iterator[FilmFrame]:
    """Frames between two states, both excluded."""
    if before.robot != after.robot:
        yield from _driving(world, before, after)
        return
    changed = before.poses != after.poses or before.joints != after.joints
    for number in range(1, REACH_FRAMES if changed else 1):
        yield _mixed(world.scene, before, after, number / REACH_FRAMES)


def _driving(world: LiveWorld, before: FilmFrame, after: FilmFrame) -> Iterator[FilmFrame]:
    """Frames of a drive. Carried objects stay before the robot."""
    held = {name: hand_pose(before.robot).inverse() @ before.poses[name] for name in world.carried}
    for robot in along(world.navigator.path(before.robot, after.robot), before.robot, after.robot):
        poses = dict(after.poses)
        for name, offset in held.items():
            poses[name] = hand_pose(robot) @ offset
        yield FilmFrame(robot, after.step, poses, after.joints, after.hidden)


def along(points: Sequence[tuple[float, float]], start: StandPose, end: StandPose) -> Iterator[StandPose]:
    """Poses at ``FRAMES_PER_S`` along a path: turn, drive, turn to the final heading. Both ends are excluded."""
    heading = start.yaw
    corners = [(start.x_m, start.y_m), *points, (end.x_m, end.y_m)]
    for (ax, ay), (bx, by) in itertools.pairwise(corners):
        length = math.hypot(bx - ax, by - ay)
        if length < 1e-6:
            continue
        course = math.atan2(by - ay, bx - ax)
        yield from _turning(ax, ay, heading, course)
        heading = course
        count = max(1, round(length / DRIVE_M_S * FRAMES_PER_S))
        for number in range(1, count + 1):
            share = number / count
            yield StandPose(ax + (bx - ax) * share, ay + (by - ay) * share, heading)
    yield from _turning(end.x_m, end.y_m, heading, end.yaw)


def _turning(x: float, y: float, before: float, after: float) -> Iterator[StandPose]:
    angle = math.remainder(after - before, math.tau)
    count = round(abs(angle) / TURN_RAD_S * FRAMES_PER_S)
    for number in range(1, count):
        yield StandPose(x, y, before + angle * number / count)


def _mixed(scene: Scene, before: FilmFrame, after: FilmFrame, share: float) -> FilmFrame:
    """Interpolated frame: joints and positions are mixed, headings are those of ``after``."""
    poses: dict[str, Pose] = {}
    for name in {*before.poses, *after.poses} - after.hidden:
        placed = scene.by_name[name].pose_world_asset
        start, end = (frame.poses.get(name, placed) for frame in (before, after))
        x, y, z = (a + (b - a) * share for a, b in zip(start.position_m, end.position_m, strict=True))
        poses[name] = Pose((x, y, z), end.quat_xyzw)
    joints: dict[str, tuple[float, ...]] = {}
    for name in {*before.joints, *after.joints}:
        first = scene.by_name[name].joints
        pairs = zip(before.joints.get(name, first), after.joints.get(name, first), strict=True)
        joints[name] = tuple(a + (b - a) * share for a, b in pairs)
    return FilmFrame(after.robot, after.step, poses, joints, after.hidden)
