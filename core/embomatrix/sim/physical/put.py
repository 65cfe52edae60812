"""Putting: the hand brings what it holds in on a free way, sets it down, lets go and leaves."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.physical.fold import arrivals
from embomatrix.sim.physical.hands import GENTLE, ROOFED_RAISE_M, bases_at, way_in
from embomatrix.sim.physical.motion import raised
from embomatrix.sim.physical.reach import ArmReach, Track
from embomatrix.sim.physical.travel import SOMETHING
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import refuse
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.sim.physical.reach import Way
    from embomatrix.sim.physical.stage import Grip, PhysicalStage
    from embomatrix.skills.view import SkillRefusal

CHUNKS: Final = (0, 1, 4, 9, 16, 24)
"""Poses are looked at a few at a time: the robot stands elsewhere for each lot."""
FITS: Final = 48
"""Turned poses of one lot that are looked at: those in the open first, then the less deep ones."""
DROPS_M: Final = (0.03, 0.06, 0.12, 0.24, 0.4)
"""Heights from which things are dropped where the hand can't follow."""
RISE_M: Final = 0.01
DROP_M: Final = 0.004
"""The hand lets go when what it holds touches, or this far below where it should."""
LEVEL: Final = 0.3
"""A hand that points down more steeply than this has no heading."""
ASIDES: Final = (0.0, 35.0, -35.0)
"""Degrees by which the hand may come from aside when it puts something."""
ROOFED_ASIDE: Final = math.radians(35.0)
OPEN_ASIDE: Final = math.radians(80.0)
"""What is put as it was found good, or the other way round, may make the hand come this far from aside."""


@dataclass(frozen=True, slots=True)
class Fit:
    """Where what is held may stand, the heading of the way in, and how long that is under a roof; None in the open."""

    pose: Pose
    course: float
    out_m: float | None


class PutRequest:
    """What is held, how, and where it is to go: poses of which the first is preferred, at which ``counts`` must hold.

    ``counts`` is asked with the thing standing at a pose in the planning scene.
    """

    def __init__(
        self, stage: PhysicalStage, grip: Grip, poses: Sequence[Pose], counts: Callable[[], bool]
    ) -> None:
        self._stage = stage
        self._grip = grip
        self._poses = poses
        self._counts = counts
        self._boxes = stage.boxes()
        self.reach = ArmReach(self._boxes, self._boxes, grip.held)

    def ways(self) -> Iterator[Way]:
        """Ways to put it down, to the first pose while there are any."""
        for fits in self._lots():
            if fits:
                tracks = list(_put_tracks(self._grip, fits))
                yield from self.reach.ways(tracks, bases_at(self._stage, *_at(fits[0])))

    def drops(self) -> Iterator[Way]:
        """Ways to let it fall from no higher than must be, as into a crate that is too narrow for the hand."""
        fits = [fit for pose in self._poses[: CHUNKS[2]] for some in self._fits(pose) for fit in some]
        clear_m = [self._clear_above(fit.pose) for fit in fits]
        for drop_m in DROPS_M:
            higher = [
                Fit(Pose((0.0, 0.0, drop_m)) @ fit.pose, fit.course, fit.out_m)
                for fit, most_m in zip(fits, clear_m, strict=True)
                if drop_m <= most_m
            ]
            if not higher:
                return
            tracks = list(_put_tracks(self._grip, higher))
            yield from self.reach.ways(tracks, bases_at(self._stage, *_at(higher[0])))

    def may_turn(self) -> bool:
        """Whether the thing may stand a quarter turned at one of the first poses, so that the hand may come from anywhere."""
        found = any(True for pose in self._poses[: CHUNKS[2]] for _ in self._turned(pose, math.pi / 2))
        self._stage.world.engine.park(self._grip.name)
        return found

    def _clear_above(self, pose: Pose) -> float:
        """How far straight up from a pose the thing could come from, as far as drops go."""
        engine, name = self._stage.world.engine, self._grip.name
        risen = 0
        while risen * RISE_M < DROPS_M[-1]:
            engine.set_pose(name, Pose((0.0, 0.0, (risen + 1) * RISE_M)) @ pose)
            if engine.penetrates(name):
                break
            risen += 1
        engine.park(name)
        return risen * RISE_M

    def _lots(self) -> Iterator[list[Fit]]:
        """The first pose with the thing as it was found good; then turned, as the hand comes best; then the other poses."""
        for first, last in itertools.pairwise(CHUNKS):
            some = [self._fits(pose) for pose in self._poses[first:last]]
            as_found = [fit for fits, _ in some for fit in fits]
            turned = [fit for _, fits in some for fit in fits]
            lots = (as_found, turned) if first == 0 else (as_found + turned,)
            for fits in lots:
                fits.sort(key=lambda fit: fit.out_m or 0.0)
                roofed = [Fit(fit.pose, fit.course, None) for fit in fits if fit.out_m is not None]
                yield [*fits[:FITS], *roofed[:FITS]]

    def _fits(self, pose: Pose) -> tuple[list[Fit], list[Fit]]:
        """A pose as it is and the other way round, as far as the hand can come so; then turned to where the hand comes from."""
        engine, name = self._stage.world.engine, self._grip.name
        engine.set_pose(name, pose)
        course, out_m = way_in(self._stage, name, engine.aabb(name), self._boxes)
        pointing = (pose @ self._grip.pose_tool_object.inverse()).rotation[:, 2]
        if math.hypot(pointing[0], pointing[1]) > LEVEL:
            off = math.remainder(course - math.atan2(pointing[1], pointing[0]), math.tau)
            aside = OPEN_ASIDE if out_m is None else ROOFED_ASIDE
            same = [turn for turn in (0.0, math.pi) if abs(math.remainder(off - turn, math.tau)) <= aside]
            other = [math.remainder(off + math.radians(by), math.tau) for by in ASIDES]
        else:
            same, other = [0.0, math.pi], [math.pi / 2, -math.pi / 2]
        found = [
            [Fit(turned, course, out_m) for turn in turns for turned in self._turned(pose, turn)]
            for turns in (same, other)
        ]
        engine.park(name)
        return found[0], found[1]

    def _turned(self, pose: Pose, turn: float) -> Iterator[Pose]:
        """The pose turned about the vertical, if the thing can stand there so."""
        if not turn:
            yield pose
            return
        about = Pose.from_xyz_yaw(0.0, 0.0, 0.0, turn) @ Pose((0.0, 0.0, 0.0), pose.quat_xyzw)
        turned = Pose(pose.position_m, about.quat_xyzw)
        engine, name = self._stage.world.engine, self._grip.name
        engine.set_pose(name, turned)
        if not engine.penetrates(name) and self._counts():
            yield turned


def _at(fit: Fit) -> tuple[Pose, float, float | None]:
    return fit.pose, fit.course, fit.out_m


def put(
    stage: PhysicalStage, poses: Sequence[Pose], counts: Callable[[], bool], target: str
) -> SkillRefusal | None:
    """Bring what is held to the first of several poses that the arm gets at, let go, and draw the hand back.

    ``counts`` tells whether what is held may stay where it stands in the planning scene. A refusal names the target where
    nothing else is known to bar the way; what is held may be in the hand still.
    """
    assert stage.grip is not None
    delivery = PutRequest(stage, stage.grip, poses, counts)
    return _bring(stage, delivery, delivery.ways(), target)


def drop(
    stage: PhysicalStage, poses: Sequence[Pose], counts: Callable[[], bool], target: str
) -> SkillRefusal | None:
    """As ``put``, but let it fall from as little above one of the poses as the hand can come."""
    assert stage.grip is not None
    delivery = PutRequest(stage, stage.grip, poses, counts)
    return _bring(stage, delivery, delivery.drops(), target)


def _bring(
    stage: PhysicalStage,
    delivery: PutRequest,
    ways: Iterator[Way],
    target: str,
) -> SkillRefusal | None:
    grip = stage.grip
    assert grip is not None
    refusal = None
    for way, refusal in arrivals(stage, ways, delivery.reach, loaded=True):
        if refusal is None:
            return _set_down(stage, way)
    other = delivery.reach.hindrance or target
    return refusal or refuse(FailureReason.ARM_BLOCKED, target=f"a place for {grip.name}", other=other)


def _put_tracks(grip: Grip, fits: Sequence[Fit]) -> Iterator[Track]:
    """Ways that bring what is held to a pose and the empty hand back from there: in, down, and out."""
    back = grip.pose_tool_object.inverse()
    for fit in fits:
        tool = fit.pose @ back
        rotation, point = tool.rotation, np.array(tool.position_m)
        inward = np.array([math.cos(fit.course), math.sin(fit.course), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        if fit.out_m is None:
            before = [point + 0.12 * up, point + 0.05 * up]
            after = [point - 0.05 * rotation[:, 2] + 0.01 * up, point - 0.1 * rotation[:, 2] + 0.03 * up]
        else:
            count = max(2, math.ceil(fit.out_m / 0.12) + 1)
            steps = np.linspace(fit.out_m, 0.0, count)[:, None]
            before = list(point + ROOFED_RAISE_M * up - steps * inward)
            off = point - 0.04 * rotation[:, 2] + 0.012 * up
            after = [off, *(off - steps[::-1][1:] * inward)]
        positions = np.array([*before, point, *after])
        loaded = np.arange(len(positions)) < len(before)
        yield Track(np.tile(rotation, (len(positions), 1, 1)), positions, loaded, len(before))


def _set_down(stage: PhysicalStage, way: Way) -> SkillRefusal | None:
    """Follow a way down to where the thing touches, let go, and follow it out."""
    grip, world = stage.grip, stage.world
    assert grip is not None
    name = grip.name
    key = way.track.key
    hit = stage.mover.advance(way.postures[1:key])
    if hit is not None or stage.has_slipped():
        reason = FailureReason.SLIPPED if stage.has_slipped() else FailureReason.ARM_BLOCKED
        return refuse(reason, target=name, other=hit or SOMETHING)
    lower = raised(way.postures[key], -DROP_M)
    ignore = frozenset(world.carried)
    stage.mover.follow(
        np.stack([way.postures[key], lower]), GENTLE, lambda: bool(stage.dynamic.touched_by(name, ignore))
    )
    stage.loosen()
    stage.mover.wait(16)
    _let_go(stage)
    stage.mover.advance(way.postures[key + 1 :], 0.5)
    stage.dynamic.part_from(name)
    return None


def _let_go(stage: PhysicalStage) -> None:
    """Put what the hand held, and what lay in it, into the planning scene where it now is."""
    world = stage.world
    group = world.carried
    world.hand.forget()
    for name in group:
        world.engine.set_pose(name, stage.dynamic.bodies.pose(name))
    world.navigator.refresh()
