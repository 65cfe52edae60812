"""Taking another hold: what the hand can't bring where it goes as it holds it is put down nearby and taken otherwise."""

from __future__ import annotations

import itertools
import math
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.physical.fold import fold
from embomatrix.sim.physical.grasp import grasp_tracks
from embomatrix.sim.physical.hands import bases_at, take_by, way_in
from embomatrix.sim.physical.put import PutRequest, put
from embomatrix.sim.placing.trial import in_reach
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from embomatrix.sim.physical.reach import Track
    from embomatrix.sim.physical.stage import Grip, PhysicalStage
    from embomatrix.world.geometry import FloatArray
    from embomatrix.world.poses import StandPose

HOSTS: Final = 3
"""Surfaces nearby that are looked at."""
ON_EACH: Final = 4
"""Poses on each of them."""
RING_M: Final = (0.6, 0.75)
RING_DEGREES: Final = (0.0, 40.0, -40.0, 80.0, -80.0, 130.0, -130.0, 180.0)
"""Places on the floor around the robot."""
LOOKED_AT: Final = 10
"""Kinds of holds that are looked at with the hand at one side of the thing, before all are at every side."""
FORESEEN: Final = 4
"""Poses at the goal for which a hold is looked at."""
ALIKE: Final = math.cos(math.radians(25.0))
"""Cosine of the turn up to which two holds are alike: ways to take a thing are offered at headings 40 degrees apart."""
LIFT_M: Final = 0.001
"""Above the floor, when nothing is known of how the thing stands on it."""


class Turns(Enum):
    """By which turns about the vertical a hold may differ from another and be as good: the thing is put turned by as much."""

    ANY = auto()
    HALF = auto()
    NONE = auto()


def regrasp(
    stage: PhysicalStage,
    poses: Sequence[Pose],
    counts: Callable[[], bool],
    home: StandPose,
) -> bool:
    """Put down what is held and take it so that the hand can bring it to one of some poses. Whether it is held again.

    ``counts`` tells whether it may stay where it stands in the planning scene, with the poses in mind.
    """
    grip = stage.grip
    assert grip is not None
    name = grip.name
    engine, asset = stage.world.engine, stage.world.asset(name)
    rests = list(_rests(stage, name, poses[0]))
    if not rests:
        return False
    # Where exactly it will rest makes no difference to which holds lead to the goal.
    offered = grasp_tracks(asset, rests[0], engine.joints(name), home.yaw, None)
    foreseen, turns = _foresee(stage, grip, offered, rests[0], poses, counts)
    if not foreseen or put(stage, rests, _anywhere, name) is not None:
        return False
    fold(stage, home)
    stage.settle()
    pose = engine.pose(name)
    course, out_m = way_in(stage, name, engine.aabb(name), stage.boxes())
    tracks = grasp_tracks(asset, pose, engine.joints(name), course, out_m)
    bases = bases_at(stage, pose, course, out_m)
    refusal = None
    ranks = [_rank(track, pose, foreseen, turns) for track in tracks]
    # Where none of the holds that lead to the goal can be taken, any is better than to leave the thing there.
    for wanted in sorted(set(ranks)):
        some = [track for track, rank in zip(tracks, ranks, strict=True) if rank == wanted]
        refusal = take_by(stage, name, some, len(some) if out_m is not None else 0, bases)
        if refusal is None:
            break
    fold(stage, home)
    return refusal is None and stage.grip is not None


def _anywhere() -> bool:
    return True


def _rank(
    track: Track, pose: Pose, foreseen: Mapping[tuple[float, float], Sequence[FloatArray]], turns: Turns
) -> int:
    """0 for a way to take a thing at a pose after which it is held as foreseen, 1 for another of a foreseen kind, else 2."""
    holds = foreseen.get(_kind(track), ())
    if not holds:
        return 2
    if turns is Turns.ANY:
        return 0
    now = pose.rotation.T @ track.rotation[track.key]
    cosines = [(float(np.trace(now @ hold.T)) - 1.0) / 2.0 for hold in holds]
    if turns is Turns.HALF:
        cosines = [abs(cosine) for cosine in cosines]
    return 0 if max(cosines) >= ALIKE else 1


def _kind(track: Track) -> tuple[float, float]:
    """How the hand points down and rolls at the end: ways that differ by their heading alone are of one kind.

    Which of these is taken makes no difference where the thing may be turned about the vertical. On a narrow top it may not.
    """
    rotation = track.rotation[track.key]
    return round(float(rotation[2, 2]), 2), round(abs(float(rotation[2, 1])), 2)


def _kinds(offered: Sequence[Track], *, by_heading: bool = False) -> list[Track]:
    """The first way of each kind, the preferred ones first; ``by_heading`` of each kind and heading."""
    first: dict[tuple[float, ...], Track] = {}
    for track in offered:
        x, y, _ = track.rotation[track.key][:, 2].tolist()
        first.setdefault((*_kind(track), round(math.atan2(y, x), 1) if by_heading else 0.0), track)
    return list(first.values())


def _foresee(
    stage: PhysicalStage,
    grip: Grip,
    offered: Sequence[Track],
    rest: Pose,
    poses: Sequence[Pose],
    counts: Callable[[], bool],
) -> tuple[dict[tuple[float, float], list[FloatArray]], Turns]:
    """Holds that lead to a goal, as ``_leading`` tells them, and by which turns about the vertical others may differ."""
    goals = poses[:FORESEEN]
    found = _leading(stage, grip, _kinds(offered)[:LOOKED_AT], rest, goals, counts)
    if found:
        return found, Turns.ANY if PutRequest(stage, grip, poses, counts).may_turn() else Turns.HALF
    # Where the thing hardly fits, the hand may have to be at one certain side of it.
    return _leading(stage, grip, _kinds(offered, by_heading=True), rest, goals, counts), Turns.NONE


def _leading(
    stage: PhysicalStage,
    grip: Grip,
    offered: Sequence[Track],
    rest: Pose,
    poses: Sequence[Pose],
    counts: Callable[[], bool],
) -> dict[tuple[float, float], list[FloatArray]]:
    """Kinds of ways to take what is held, from where it would stand, after which there is a way to one of the poses.

    With each come the turns of the tool in the thing's frame with which there is, (3, 3) each.
    """
    found: dict[tuple[float, float], list[FloatArray]] = {}
    for track in offered:
        tool = track.key_pose
        delivery = PutRequest(stage, grip.otherwise(tool.inverse() @ rest), poses, counts)
        if next(delivery.ways(), None) is not None:
            found.setdefault(_kind(track), []).append(rest.rotation.T @ tool.rotation)
    return found


def _rests(stage: PhysicalStage, name: str, upright: Pose) -> Iterator[Pose]:
    """Where what is held may stand for a while: on furniture in reach, the nearest first, then on the floor."""
    world, robot = stage.world, stage.world.robot
    x, y, wide = robot.x_m, robot.y_m, ROBOT.reach_m
    around = Aabb((x - wide, y - wide, 0.0), (x + wide, y + wide, ROBOT.reach_high_m))
    hosts = [
        other for other in world.engine.near(around) if world.is_fixed(other) and world.asset(other).supports
    ]
    hosts.sort(key=lambda other: math.dist(world.engine.aabb(other).center_m[:2], (x, y)))
    for host in hosts[:HOSTS]:
        found = world.placer.choices(name, host, Relation.ONTOP, robot, most=ON_EACH)
        if not isinstance(found, FailureReason):
            yield from found
    yield from _on_floor(stage, name, upright)


def _on_floor(stage: PhysicalStage, name: str, upright: Pose) -> Iterator[Pose]:
    """Free places on the floor around the robot, for a thing that stands as it does at a pose."""
    engine, robot = stage.world.engine, stage.world.robot
    engine.set_pose(name, upright)
    above = upright.position_m[2] - engine.aabb(name).low_m[2] + LIFT_M
    found = []
    for away, degrees in itertools.product(RING_M, RING_DEGREES):
        course = robot.yaw + math.radians(degrees)
        x, y = robot.x_m + away * math.cos(course), robot.y_m + away * math.sin(course)
        pose = Pose((x, y, above), upright.quat_xyzw)
        engine.set_pose(name, pose)
        if in_reach(engine.aabb(name), robot) and not engine.penetrates(name):
            found.append(pose)
    engine.park(name)
    yield from found
