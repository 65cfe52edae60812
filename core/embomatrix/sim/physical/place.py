"""Placing: poses for the held object, regrasping if the hand can't reach them, and a check that the object stays."""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum, auto
from typing import Final

import numpy as np

from embomatrix.sim.actions import other_stands
from embomatrix.sim.blockers import no_place_refusal
from embomatrix.sim.physical.fold import fold
from embomatrix.sim.physical.grasp import grasp_tool_paths
from embomatrix.sim.physical.pick import bases_at, entry, take_by
from embomatrix.sim.physical.put import PutRequest, put
from embomatrix.sim.physical.reach import ToolPath
from embomatrix.sim.physical.stage import Grip, PhysicalStage
from embomatrix.sim.physical.travel import travel
from embomatrix.sim.placing.search import in_reach
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.skills.syntax import SkillCall
from embomatrix.skills.view import SkillRefusal, preposition, refuse, target_of
from embomatrix.world.geometry import Aabb, FloatArray, Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.state import Relation

PLACES: Final = 24
HOSTS: Final = 3
"""Nearby surfaces to consider for putting an object down during a regrasp."""
ON_EACH: Final = 4
"""Poses on each of them."""
RING_M: Final = (0.6, 0.75)
RING_DEGREES: Final = (0.0, 40.0, -40.0, 80.0, -80.0, 130.0, -130.0, 180.0)
"""Places on the floor around the robot: distances and directions."""
EXAMINED: Final = 10
"""Kinds of grasps to examine at one side of the object, before all kinds at every side."""
FORESEEN: Final = 4
"""Goal poses for which a grasp is examined."""
ALIKE: Final = math.cos(math.radians(25.0))
"""Cosine of the largest rotation between two grasps that count as alike. Tool paths differ by 40 degrees of heading."""
LIFT_M: Final = 0.001
"""Height above the floor for objects whose standing pose is unknown."""


class Turns(Enum):
    """Rotations about the vertical by which a grasp may differ: the object is then placed with that rotation."""

    ANY = auto()
    HALF = auto()
    NONE = auto()


def place(stage: PhysicalStage, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    """Put the held object at a free pose of the planning scene, and check that it stays."""
    world, grip = stage.world, stage.grip
    assert grip is not None
    assert call.relation is not None
    home, held, target = stage.commanded, grip.name, target_of(world, call)
    relation = Relation(call.relation.value)
    words = {"held": held, "target": target, "relation": preposition(call.relation)}
    found, stand = _places(stage, target, relation, rng)
    if found is FailureReason.NO_FREE_POSE:
        stands = (home, *other_stands(world, target))
        return no_place_refusal(world, held, target, call.relation, stands)
    if isinstance(found, FailureReason):
        return refuse(found, **words)
    if stand is not home:
        refusal = travel(stage, stand, target)
        if refusal is not None:
            return refusal
        home = stand

    def is_valid() -> bool:
        return world.relations.holds(relation, held, target)

    refusal = put(stage, found, is_valid, target)
    if refusal is not None and stage.grip is not None:
        fold(stage, home, target)
        if regrasp(stage, found, is_valid, home):
            refusal = put(stage, found, is_valid, target)
        if refusal is not None and stage.grip is not None:
            refusal = put(stage, found, is_valid, target, dropped=True)
    fold(stage, home, target)
    if stage.grip is not None:
        return refusal
    stage.settle()
    if refusal is None and not is_valid():
        return refuse(FailureReason.FELL, **words)
    return refusal


def _places(
    stage: PhysicalStage, target: str, relation: Relation, rng: np.random.Generator
) -> tuple[tuple[Pose, ...] | FailureReason, StandPose]:
    """Return poses for the held object, or the reason why there are none, and the standing pose for them, as in cached mode."""
    world = stage.world
    held, here = world.carried[0], stage.commanded
    found = world.placer.choices(held, target, relation, here, rng, most=PLACES)
    if found is FailureReason.NO_FREE_POSE:
        for stand in other_stands(world, target):
            more = world.placer.choices(held, target, relation, stand, rng, most=PLACES)
            if not isinstance(more, FailureReason):
                return more, stand
    return found, here


def regrasp(
    stage: PhysicalStage,
    poses: Sequence[Pose],
    is_valid: Callable[[], bool],
    home: StandPose,
) -> bool:
    """Put the held object down and pick it up so that the hand can bring it to one of some poses. True if it is held again.

    ``is_valid`` returns True if the object may stay at its present pose in the planning scene.
    """
    grip = stage.grip
    assert grip is not None
    name = grip.name
    engine, asset = stage.world.engine, stage.world.asset(name)
    rests = list(_rests(stage, name, poses[0]))
    if not rests:
        return False
    # The exact resting pose does not affect which grasps lead to the goal.
    offered = grasp_tool_paths(asset, rests[0], engine.joints(name), home.yaw, None)
    foreseen, turns = _foresee(stage, grip, offered, rests[0], poses, is_valid)
    if not foreseen or put(stage, rests, lambda: True, name) is not None:
        return False
    fold(stage, home)
    stage.settle()
    pose = engine.pose(name)
    course, depth_m = entry(stage, name, engine.aabb(name), stage.boxes())
    tool_paths = grasp_tool_paths(asset, pose, engine.joints(name), course, depth_m)
    bases = bases_at(stage, pose, course, depth_m)
    refusal = None
    ranks = [_rank(tool_path, pose, foreseen, turns) for tool_path in tool_paths]
    # If no suitable grasp is possible, any grasp is better than leaving the object there.
    for wanted in sorted(set(ranks)):
        some = [tool_path for tool_path, rank in zip(tool_paths, ranks, strict=True) if rank == wanted]
        refusal = take_by(stage, name, some, len(some) if depth_m is not None else 0, bases)
        if refusal is None:
            break
    fold(stage, home)
    return refusal is None and stage.grip is not None


def _rank(
    tool_path: ToolPath,
    pose: Pose,
    foreseen: Mapping[tuple[float, float], Sequence[FloatArray]],
    turns: Turns,
) -> int:
    """Rank a tool path for picking up an object: 0 if it gives a foreseen grasp, 1 for another grasp of that kind, else 2."""
    holds = foreseen.get(_kind(tool_path), ())
    if not holds:
        return 2
    if turns is Turns.ANY:
        return 0
    now = pose.rotation.T @ tool_path.rotation[tool_path.key]
    cosines = [(float(np.trace(now @ hold.T)) - 1.0) / 2.0 for hold in holds]
    if turns is Turns.HALF:
        cosines = [abs(cosine) for cosine in cosines]
    return 0 if max(cosines) >= ALIKE else 1


def _kind(tool_path: ToolPath) -> tuple[float, float]:
    """Kind of a grasp: pointing elevation and roll of the hand, without its heading.

    Any heading is good where the object may be rotated about the vertical; on a narrow top it may not.
    """
    rotation = tool_path.rotation[tool_path.key]
    return round(float(rotation[2, 2]), 2), round(abs(float(rotation[2, 1])), 2)


def _kinds(offered: Sequence[ToolPath], *, by_heading: bool = False) -> list[ToolPath]:
    """Return the first tool path of each kind; with ``by_heading`` of each kind and heading."""
    first: dict[tuple[float, ...], ToolPath] = {}
    for tool_path in offered:
        x, y, _ = tool_path.rotation[tool_path.key][:, 2].tolist()
        first.setdefault((*_kind(tool_path), round(math.atan2(y, x), 1) if by_heading else 0.0), tool_path)
    return list(first.values())


def _foresee(
    stage: PhysicalStage,
    grip: Grip,
    offered: Sequence[ToolPath],
    rest: Pose,
    poses: Sequence[Pose],
    is_valid: Callable[[], bool],
) -> tuple[dict[tuple[float, float], list[FloatArray]], Turns]:
    """Return grasps that lead to a goal, as `_grasps_leading_to` gives them, and the rotations by which others may differ."""
    goals = poses[:FORESEEN]
    found = _grasps_leading_to(stage, grip, _kinds(offered)[:EXAMINED], rest, goals, is_valid)
    if found:
        return found, Turns.ANY if PutRequest(stage, grip, poses, is_valid).may_turn() else Turns.HALF
    # Where the object barely fits, the hand may have to be at one particular side of it.
    return _grasps_leading_to(
        stage, grip, _kinds(offered, by_heading=True), rest, goals, is_valid
    ), Turns.NONE


def _grasps_leading_to(
    stage: PhysicalStage,
    grip: Grip,
    offered: Sequence[ToolPath],
    rest: Pose,
    poses: Sequence[Pose],
    is_valid: Callable[[], bool],
) -> dict[tuple[float, float], list[FloatArray]]:
    """Return the kinds of grasps from a resting pose after which the arm reaches one of the poses.

    Each kind comes with the rotations, (3, 3), of the tool in the frame of the object.
    """
    found: dict[tuple[float, float], list[FloatArray]] = {}
    for tool_path in offered:
        tool = tool_path.key_pose
        request = PutRequest(stage, grip.held_as(tool.inverse() @ rest), poses, is_valid)
        if next(request.paths(), None) is not None:
            found.setdefault(_kind(tool_path), []).append(rest.rotation.T @ tool.rotation)
    return found


def _rests(stage: PhysicalStage, name: str, upright: Pose) -> Iterator[Pose]:
    """Yield temporary poses for the held object: on furniture in reach, the nearest first, then on the floor."""
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
    """Yield free poses on the floor around the robot, with the orientation of ``upright``."""
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
