"""Search for poses of one object next to another, on whatever the other one stands on, in the engine's present state."""

import functools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.geometry.batch_poses import HANDY, BoolArray, PoseBoxes, Range
from embomatrix.sim.geometry.behind_panels import behind_panels
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.candidates import BESIDE_M, LIFT_M, YAWS, places_beside
from embomatrix.sim.geometry.surfaces import REST_M
from embomatrix.sim.placing.options import PlacementOptions
from embomatrix.sim.placing.search import (
    EXAMINED,
    LIVE_SETTLES,
    LIVE_TRIES,
    NEAR_M,
    PlacementSearch,
    in_reach,
)
from embomatrix.sim.state.relations import Relations, next_gap_m
from embomatrix.skills.failure import FailureReason
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.state import Relation

WIDE_SHARE: Final = 0.6
"""Share of the largest gap of ``nextto`` that leaves room for the hand between both objects."""

OFFSETS: Final = (0.5, -0.5, 1.0, -1.0)
"""Offsets along a side, up to the corners, for objects whose surroundings are crowded."""
TRIES: Final = 2 * LIVE_TRIES
"""Candidates to examine: each costs a test for contacts."""


@dataclass(frozen=True)
class BesidePoses:
    """Upright poses around an object, and the world boxes of the placed object at them."""

    poses: tuple[Pose, ...]
    boxes: PoseBoxes


@dataclass(frozen=True)
class BesideSearch:
    """Search for poses next to a target, in reach of a standing pose.

    A found pose is on the target's host, on a host of that host or on the floor. ``nextto`` holds there, the object penetrates
    nothing and is stable. Poses within reach of ``excluded_stands`` are skipped. The search moves the held object and leaves it
    where it was tried last. ``surroundings`` answers for the arm's reach into the target's host; None on the floor.
    """

    engine: PhysicsEngine
    relations: Relations
    options: PlacementOptions
    held: str
    target: str
    robot: StandPose
    surroundings: PlacementSearch | None
    excluded_stands: tuple[StandPose, ...] = ()
    relation = Relation.NEXTTO

    def poses(self, rng: np.random.Generator | None) -> Iterator[Pose]:
        """Accepted poses: those with nothing around first, and among equals those that are easy to reach."""
        found = self._around
        order = range(len(found.poses)) if rng is None else rng.permutation(len(found.poses)).tolist()
        settles = 0
        for number in self._roomy_first(order)[:TRIES]:
            self.engine.set_pose(self.held, found.poses[number])
            if self.engine.penetrates(self.held) or not self._is_beside():
                continue
            if settles == LIVE_SETTLES:
                return
            settles += 1
            settled = self.engine.settle(self.held)
            if settled.stable and self._accepts(settled.pose):
                yield settled.pose

    def fits(self) -> bool:
        """Return True if the target stands on something, so that objects may stand beside it."""
        return bool(self._around.poses)

    def hindrance(self) -> tuple[FailureReason, str]:
        """Reason why no pose is accepted, and the object in the way at most of the places; "" if none is to blame."""
        found = self._around
        served = np.flatnonzero(self._served(found.boxes, self.robot)).tolist()
        if not served:
            is_reached = bool(found.boxes.reached_from(self.robot).any())
            return FailureReason.PLACES_BEHIND_DOOR if is_reached else FailureReason.PLACES_OUT_OF_REACH, ""
        met = Counter[str]()
        for number in served[:EXAMINED]:
            self.engine.set_pose(self.held, found.poses[number])
            met[self.engine.penetrates(self.held)] += 1
        # Ties go to the first by name: the answer is part of the trace.
        others = sorted(met.keys() - {"", self.target})
        return FailureReason.NO_FREE_POSE, max(others, key=lambda name: met[name], default="")

    @functools.cached_property
    def _around(self) -> BesidePoses:
        """Poses at the target's four sides, level with its underside; none if it hangs at a wall."""
        engine, held, target = self.engine, self.held, self.target
        low_m = engine.aabb(target).low_m[2]
        if self.relations.host_of(target) is None and abs(low_m) > REST_M:
            return BesidePoses((), PoseBoxes(np.zeros((0, 3)), np.zeros((0, 3))))
        bounds, joints = bounds_of(engine.scene.asset_of(held)), engine.joints(held)
        pose = engine.pose(target)
        x, y, _ = pose.position_m
        # Objects stand square to the target, along its own sides.
        frame = Pose.from_xyz_yaw(x, y, 0.0, pose.yaw)
        around = bounds_of(engine.scene.asset_of(target)).box(frame.inverse() @ pose, engine.joints(target))
        poses: list[Pose] = []
        boxes: list[Aabb] = []
        for yaw in YAWS:
            box = bounds.box(Pose.from_xyz_yaw(0.0, 0.0, 0.0, yaw), joints)
            height_m = low_m - box.low_m[2] + LIFT_M
            for gap_m in (BESIDE_M, WIDE_SHARE * next_gap_m(box, around)):
                for along, across in places_beside(box, around, gap_m, OFFSETS):
                    poses.append(frame @ Pose.from_xyz_yaw(along, across, height_m, yaw))
                    boxes.append(bounds.box(poses[-1], joints))
        lows, highs = (np.array([getattr(box, name) for box in boxes]) for name in ("low_m", "high_m"))
        return BesidePoses(tuple(poses), PoseBoxes(lows, highs))

    def _roomy_first(self, order: Sequence[int]) -> list[int]:
        """Numbers of the poses in reach: those with nothing but the target and its hosts around first, handy ones leading."""
        boxes = self._around.boxes
        if not len(boxes.lows_m):
            return []
        served = self._served(boxes, self.robot)
        for stand in self.excluded_stands:
            served &= ~self._served(boxes, stand)
        ignore = frozenset((self.held, self.target, *self.relations.hosts_of(self.target)))
        near = self.engine.near(boxes.around().grown(NEAR_M), ignore)
        crowded = boxes.meet([self.engine.aabb(name) for name in near], NEAR_M)
        easy, corners = Range.of(self.robot, *HANDY), boxes.corners()
        reached = [number for number in order if served[number]]
        return sorted(reached, key=lambda number: (bool(crowded[number]), not easy.includes(corners[number])))

    def _served(self, boxes: PoseBoxes, stand: StandPose) -> BoolArray:
        """Tell for each box, shape (n,), if the arm reaches it past the open doors of the target and of its host."""
        engine, fractions = self.engine, self.engine.joints(self.target)
        reached = boxes.reached_from(stand)
        if self.surroundings is not None:
            reached &= self.surroundings.serves(boxes, stand)
        if any(fractions):
            asset = engine.scene.asset_of(self.target)
            around = self.options.barriers[asset.asset_id, engine.pose(self.target), fractions]
            if around:
                reached &= ~behind_panels(boxes, around, stand)
        return reached

    def _accepts(self, pose: Pose) -> bool:
        """Put the object at the pose where it came to rest. Return True if all conditions still hold."""
        self.engine.set_pose(self.held, pose)
        return (
            not self.engine.penetrates(self.held)
            and in_reach(self.engine.aabb(self.held), self.robot)
            and self._is_beside()
            and self._shares_support()
        )

    def _is_beside(self) -> bool:
        return self.relations.nextto(self.held, self.target)

    def _shares_support(self) -> bool:
        """Return True if the object rests on or in a host of the target, or on the floor."""
        host = self.relations.host_of(self.held)
        if host is not None:
            return host.name in self.relations.hosts_of(self.target)
        return self.engine.aabb(self.held).low_m[2] <= REST_M
