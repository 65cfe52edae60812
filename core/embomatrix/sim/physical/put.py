"""Putting down: the hand brings the held object in on a free path, sets it down, lets go and leaves."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.sim.physical.fold import arrivals
from embomatrix.sim.physical.motion import raised
from embomatrix.sim.physical.pick import GENTLE_PACE, ROOFED_RAISE_M, bases_at, entry
from embomatrix.sim.physical.reach import ArmPath, ArmReach, ToolPath
from embomatrix.sim.physical.stage import Grip, PhysicalStage
from embomatrix.sim.physical.travel import SOMETHING
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import SkillRefusal, refuse
from embomatrix.world.geometry import Pose

CHUNKS: Final = (0, 1, 4, 9, 16, 24)
"""Poses are examined in these lots. The robot stands elsewhere for each lot."""
MOST_OPTIONS: Final = 48
"""Rotated poses of one lot to examine: first those in the open, then the less deep ones."""
DROPS_M: Final = (0.03, 0.06, 0.12, 0.24, 0.4)
"""Heights from which the object is dropped if the hand can't reach its pose."""
RISE_M: Final = 0.01
DROP_M: Final = 0.004
"""The hand lets go at contact, or this far below the pose."""
LEVEL: Final = 0.3
"""A hand that points down more steeply than this has no heading."""
ASIDES: Final = (0.0, 35.0, -35.0)
"""Angles, in degrees, by which the hand may come from the side."""
ROOFED_ASIDE: Final = math.radians(35.0)
OPEN_ASIDE: Final = math.radians(80.0)
"""Largest angle from the side for an object in its verified orientation, or half turned."""


@dataclass(frozen=True, slots=True)
class PutPose:
    """Pose for the held object, heading of the entry, and length of the way under a roof; None in the open."""

    pose: Pose
    course: float
    depth_m: float | None


class PutRequest:
    """Poses for a held object, the preferred one first, at which ``is_valid`` must hold.

    ``is_valid`` is called while the object is at a pose in the planning scene.
    """

    def __init__(
        self, stage: PhysicalStage, grip: Grip, poses: Sequence[Pose], is_valid: Callable[[], bool]
    ) -> None:
        self._stage = stage
        self._grip = grip
        self._poses = poses
        self._is_valid = is_valid
        self._boxes = stage.boxes()
        self.reach = ArmReach(self._boxes, self._boxes, grip.held)

    def paths(self) -> Iterator[ArmPath]:
        """Yield paths that put the object down, to the first pose as long as there are any."""
        for options in self._option_lots():
            if options:
                tool_paths = list(_put_tool_paths(self._grip, options))
                yield from self.reach.paths(tool_paths, bases_at(self._stage, *_at(options[0])))

    def drops(self) -> Iterator[ArmPath]:
        """Yield paths that drop the object from the least height, as into a crate too narrow for the hand."""
        options = [
            option for pose in self._poses[: CHUNKS[2]] for some in self._put_poses(pose) for option in some
        ]
        clear_m = [self._clear_above(option.pose) for option in options]
        for drop_m in DROPS_M:
            higher = [
                PutPose(Pose((0.0, 0.0, drop_m)) @ option.pose, option.course, option.depth_m)
                for option, most_m in zip(options, clear_m, strict=True)
                if drop_m <= most_m
            ]
            if not higher:
                return
            tool_paths = list(_put_tool_paths(self._grip, higher))
            yield from self.reach.paths(tool_paths, bases_at(self._stage, *_at(higher[0])))

    def may_turn(self) -> bool:
        """True if the object may stand a quarter turned at one of the first poses, so that the hand may come from anywhere."""
        found = any(True for pose in self._poses[: CHUNKS[2]] for _ in self._turned(pose, math.pi / 2))
        self._stage.world.engine.park(self._grip.name)
        return found

    def _clear_above(self, pose: Pose) -> float:
        """Free height straight above a pose, up to the largest drop."""
        engine, name = self._stage.world.engine, self._grip.name
        risen = 0
        while risen * RISE_M < DROPS_M[-1]:
            engine.set_pose(name, Pose((0.0, 0.0, (risen + 1) * RISE_M)) @ pose)
            if engine.penetrates(name):
                break
            risen += 1
        engine.park(name)
        return risen * RISE_M

    def _option_lots(self) -> Iterator[list[PutPose]]:
        """Yield the first pose in its verified orientation, then rotated to suit the hand, then the other poses."""
        for first, last in itertools.pairwise(CHUNKS):
            some = [self._put_poses(pose) for pose in self._poses[first:last]]
            as_found = [option for options, _ in some for option in options]
            turned = [option for _, options in some for option in options]
            lots = (as_found, turned) if first == 0 else (as_found + turned,)
            for options in lots:
                options.sort(key=lambda option: option.depth_m or 0.0)
                roofed = [
                    PutPose(option.pose, option.course, None)
                    for option in options
                    if option.depth_m is not None
                ]
                yield [*options[:MOST_OPTIONS], *roofed[:MOST_OPTIONS]]

    def _put_poses(self, pose: Pose) -> tuple[list[PutPose], list[PutPose]]:
        """Return a pose unchanged and half turned, if the hand can reach it, and the pose rotated to suit the hand."""
        engine, name = self._stage.world.engine, self._grip.name
        engine.set_pose(name, pose)
        course, depth_m = entry(self._stage, name, engine.aabb(name), self._boxes)
        pointing = (pose @ self._grip.pose_tool_object.inverse()).rotation[:, 2]
        if math.hypot(pointing[0], pointing[1]) > LEVEL:
            off = math.remainder(course - math.atan2(pointing[1], pointing[0]), math.tau)
            aside = OPEN_ASIDE if depth_m is None else ROOFED_ASIDE
            same = [turn for turn in (0.0, math.pi) if abs(math.remainder(off - turn, math.tau)) <= aside]
            other = [math.remainder(off + math.radians(by), math.tau) for by in ASIDES]
        else:
            same, other = [0.0, math.pi], [math.pi / 2, -math.pi / 2]
        found = [
            [PutPose(turned, course, depth_m) for turn in turns for turned in self._turned(pose, turn)]
            for turns in (same, other)
        ]
        engine.park(name)
        return found[0], found[1]

    def _turned(self, pose: Pose, turn: float) -> Iterator[Pose]:
        """Yield the pose rotated about the vertical, if the object can stand there so."""
        if not turn:
            yield pose
            return
        about = Pose.from_xyz_yaw(0.0, 0.0, 0.0, turn) @ Pose((0.0, 0.0, 0.0), pose.quat_xyzw)
        turned = Pose(pose.position_m, about.quat_xyzw)
        engine, name = self._stage.world.engine, self._grip.name
        engine.set_pose(name, turned)
        if not engine.penetrates(name) and self._is_valid():
            yield turned


def _at(option: PutPose) -> tuple[Pose, float, float | None]:
    return option.pose, option.course, option.depth_m


def put(
    stage: PhysicalStage,
    poses: Sequence[Pose],
    is_valid: Callable[[], bool],
    target: str,
    *,
    dropped: bool = False,
) -> SkillRefusal | None:
    """Bring the held object to the first reachable pose, let go, and draw the hand back.

    With ``dropped``, let go at the least height above one of the poses. ``is_valid`` checks the object's present pose in the
    planning scene. A refusal names the target if no other blocker is known. The object may then still be in the hand.
    """
    grip = stage.grip
    assert grip is not None
    request = PutRequest(stage, grip, poses, is_valid)
    refusal = None
    paths = request.drops() if dropped else request.paths()
    for path, refusal in arrivals(stage, paths, request.reach, loaded=True):
        if refusal is None:
            return _set_down(stage, path)
    other = request.reach.blocker or target
    return refusal or refuse(FailureReason.ARM_BLOCKED, target=f"a place for {grip.name}", other=other)


def _put_tool_paths(grip: Grip, options: Sequence[PutPose]) -> Iterator[ToolPath]:
    """Yield tool paths that bring the object in, down to a pose, and the empty hand out."""
    back = grip.pose_tool_object.inverse()
    for option in options:
        tool = option.pose @ back
        rotation, point = tool.rotation, np.array(tool.position_m)
        inward = np.array([math.cos(option.course), math.sin(option.course), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        if option.depth_m is None:
            before = [point + 0.12 * up, point + 0.05 * up]
            after = [point - 0.05 * rotation[:, 2] + 0.01 * up, point - 0.1 * rotation[:, 2] + 0.03 * up]
        else:
            count = max(2, math.ceil(option.depth_m / 0.12) + 1)
            steps = np.linspace(option.depth_m, 0.0, count)[:, None]
            before = list(point + ROOFED_RAISE_M * up - steps * inward)
            off = point - 0.04 * rotation[:, 2] + 0.012 * up
            after = [off, *(off - steps[::-1][1:] * inward)]
        positions = np.array([*before, point, *after])
        loaded = np.arange(len(positions)) < len(before)
        yield ToolPath(np.tile(rotation, (len(positions), 1, 1)), positions, loaded, len(before))


def _set_down(stage: PhysicalStage, path: ArmPath) -> SkillRefusal | None:
    """Follow a path down until the object touches, let go, and follow it out."""
    grip, world = stage.grip, stage.world
    assert grip is not None
    name = grip.name
    key = path.tool_path.key
    hit = stage.mover.advance(path.postures[1:key])
    if hit is not None or stage.has_slipped():
        reason = FailureReason.SLIPPED if stage.has_slipped() else FailureReason.ARM_BLOCKED
        return refuse(reason, target=name, other=hit or SOMETHING)
    lower = raised(path.postures[key], -DROP_M)
    ignore = frozenset(world.carried)
    stage.mover.follow(
        np.stack([path.postures[key], lower]),
        GENTLE_PACE,
        lambda: bool(stage.dynamic.touched_by(name, ignore)),
    )
    stage.loosen()
    stage.mover.wait(16)
    stage.leave()
    stage.mover.advance(path.postures[key + 1 :], 0.5)
    stage.dynamic.part_from(name)
    return None
