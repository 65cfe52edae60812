"""Where a held object goes when it is placed: the first verified pose that is still free and in reach."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bounds import bounds_of
from embomatrix.sim.candidates import Patch, candidates, patches, proposals
from embomatrix.sim.engine import FLOOR, TOLERANCE_M
from embomatrix.sim.footprints import LEVEL_FLOOR, footprint_of, pose_box_asset
from embomatrix.sim.spots import is_shut, is_upright, link_frame, link_under, links_with_spots
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.world.poses import PlacementKey
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    import numpy as np

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.relations import Relations
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Aabb, Pose
    from embomatrix.world.poses import PoseCache, StandPose

UNDISTURBED_M: Final = 0.005
"""A pose that was verified offline is settled again when anything but its support is this near."""
TAKEN_SHARE: Final = 0.16
"""Boxes of two upright cylinders that overlap by this share of their extents along both axes are of cylinders that do."""
SAME_LEVEL_M: Final = 0.02
LIVE_TRIES: Final = 64
"""Candidates looked at beyond the cached ones."""
LIVE_SETTLES: Final = 8
"""How many of them are simulated at most."""


@dataclass(frozen=True, slots=True)
class Spot:
    """A pose in the frame of a support's link, which is the support's own for the base."""

    pose: Pose
    link: str


@dataclass(frozen=True, slots=True)
class Errand:
    """What is to be placed where, and from which standing pose it must be in reach."""

    held: str
    target: str
    relation: Relation
    robot: StandPose
    passed_over: tuple[StandPose, ...] = ()


class Placer:
    """Finds terminal poses in an engine's present state.

    A pose that is returned has the relation asked for, penetrates nothing, is within the robot's reach and stable: verified
    offline with nothing but its support within 5 mm, or settled now. Doors in the way are the caller's to check.
    """

    def __init__(self, engine: PhysicsEngine, relations: Relations, cache: PoseCache) -> None:
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self._cache = cache
        self._verified: dict[tuple[str, str, Relation], tuple[tuple[Spot, ...], tuple[Spot, ...]]] = {}
        self._patches: dict[tuple[str, str, Relation], tuple[Patch, ...]] = {}

    def find(
        self,
        held: str,
        target: str,
        relation: Relation,
        robot: StandPose,
        rng: np.random.Generator | None = None,
        passed_over: tuple[StandPose, ...] = (),
    ) -> Pose | FailureReason:
        """Pose for a parked object on, in or under another, or why there is none.

        The order of the poses follows from ``rng``; without one it is the cache's. Poses within reach of the standing poses
        ``passed_over`` are not looked at. The world is left as it was. Raises EngineError for names that the engine does not
        know.
        """
        found = self.choices(held, target, relation, robot, rng, most=1, passed_over=passed_over)
        return found if isinstance(found, FailureReason) else found[0]

    def choices(
        self,
        held: str,
        target: str,
        relation: Relation,
        robot: StandPose,
        rng: np.random.Generator | None = None,
        *,
        most: int,
        passed_over: tuple[StandPose, ...] = (),
    ) -> tuple[Pose, ...] | FailureReason:
        """The first poses, at least one and at most ``most``, that ``find`` would choose from, in its order."""
        if held == target or self._engine.is_parked(target):
            return FailureReason.PLACE_ON_ITSELF
        fails = FailureReason.NO_CAVITY if relation is Relation.INSIDE else FailureReason.NO_SURFACE
        if not is_upright(self._engine.pose(target)):
            return fails
        before = self._engine.pose(held)
        errand = Errand(held, target, relation, robot, passed_over)
        try:
            found = tuple(itertools.islice(self._search(errand, rng), most))
        finally:
            self._engine.set_pose(held, before)
            self._engine.park(held)
        if found:
            return found
        return FailureReason.NO_FREE_POSE if self._fits(held, target, relation) else fails

    def _fits(self, held: str, target: str, relation: Relation) -> bool:
        """Whether there is any pose for the one on, in or under the other when nothing else is there."""
        if any(self._cached(held, target, relation)):
            return True
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        return any(True for _ in candidates(one, other, relation, (0.5, 0.5), LIVE_TRIES))

    def _search(self, errand: Errand, rng: np.random.Generator | None) -> Iterator[Pose]:
        """Good poses: of those verified for the pair, then for the footprint's class, then of fresh ones."""
        frames = self._frames(errand)
        for spots in self._cached(errand.held, errand.target, errand.relation):
            order = range(len(spots)) if rng is None else rng.permutation(len(spots)).tolist()
            poses = (
                frames[spots[number].link] @ spots[number].pose
                for number in order
                if spots[number].link in frames
            )
            for pose in self._roomy_first(errand, poses):
                found = self._accept_verified(errand, pose)
                if found is not None:
                    yield found
        yield from self._fresh(errand, frames, rng)

    def _fresh(
        self, errand: Errand, frames: dict[str, Pose], rng: np.random.Generator | None
    ) -> Iterator[Pose]:
        """Poses for pairs that the analysis did not foresee, and on surfaces that have filled up."""
        shift = (0.5, 0.5) if rng is None else (float(rng.random()), float(rng.random()))
        found = self._patches_for(errand.held, errand.target, errand.relation)
        poses = (
            frames[patch.link] @ local
            for patch, local in proposals(found, shift, LIVE_TRIES)
            if patch.link in frames
        )
        settles = 0
        for pose in self._roomy_first(errand, poses):
            if settles == LIVE_SETTLES:
                return
            if not self._is_free(errand, pose) or not self._holds(errand):
                continue
            settles += 1
            settled = self._accept_settled(errand)
            if settled is not None:
                yield settled

    def _roomy_first(self, errand: Errand, poses: Iterable[Pose]) -> Iterator[Pose]:
        """Those in reach, in their order: first those around which there is nothing but the target, then the others.

        Boxes decide that, so it is cheap; what is really free is looked at later. Where something stands for sure is left
        out.
        """
        bounds = bounds_of(self._scene.asset_of(errand.held))
        fractions = self._engine.joints(errand.held)
        known = frozenset((errand.held, errand.target))
        close: list[Pose] = []
        for pose in poses:
            box = bounds.box(pose, fractions)
            if not in_reach(box, errand.robot) or any(in_reach(box, stand) for stand in errand.passed_over):
                continue
            near = self._engine.near(box.grown(UNDISTURBED_M + TOLERANCE_M), known)
            if not near:
                yield pose
            elif not any(self._is_taken(box, other) for other in near):
                close.append(pose)
        yield from close

    def _is_taken(self, box: Aabb, other: str) -> bool:
        """Whether a thing in the box would surely meet another.

        The boxes overlap by much, and the other is one convex body, or a vessel or the like that stands on the same level.
        """
        there = self._engine.aabb(other)
        (low_x, low_y, low_z), (high_x, high_y, high_z) = box.low_m, box.high_m
        (x, y, z), (to_x, to_y, to_z) = there.low_m, there.high_m
        if (
            min(high_x, to_x) - max(low_x, x) <= TAKEN_SHARE * (high_x - low_x + to_x - x)
            or min(high_y, to_y) - max(low_y, y) <= TAKEN_SHARE * (high_y - low_y + to_y - y)
            or min(high_z, to_z) - max(low_z, z) <= SAME_LEVEL_M
        ):
            return False
        links = self._scene.asset_of(other).links
        if len(links) == 1 and len(links[0].parts) == 1:
            return True
        return not self._scene.by_name[other].fixed and abs(low_z - z) <= SAME_LEVEL_M

    def _frames(self, errand: Errand) -> dict[str, Pose]:
        """Frame of each link of the target on which something can be placed; not of a drawer that is shut."""
        asset = self._scene.asset_of(errand.target)
        pose, fractions = self._engine.pose(errand.target), self._engine.joints(errand.target)
        shut = {
            item.link
            for item in asset.interiors
            if item.link and errand.relation is Relation.INSIDE and is_shut(asset, item, fractions)
        }
        links = ({""} | links_with_spots(asset)) - shut
        return {link: link_frame(asset, pose, fractions, link) for link in sorted(links)}

    def _cached(
        self, held: str, target: str, relation: Relation
    ) -> tuple[tuple[Spot, ...], tuple[Spot, ...]]:
        """Spots verified for this pair of assets, and those verified for the footprint of what is held."""
        one, other = self._scene.by_name[held].asset_id, self._scene.by_name[target].asset_id
        key = (one, other, relation)
        if key not in self._verified:
            exact = self._cache.placements.get(PlacementKey(one, other, relation), ())
            by_class = self._by_class(self._scene.assets[one], other, relation)
            self._verified[key] = (
                tuple(self._spot(held, target, relation, pose) for pose in exact),
                tuple(self._spot(held, target, relation, pose) for pose in by_class),
            )
        return self._verified[key]

    def _by_class(self, asset: Asset, support_id: str, relation: Relation) -> Sequence[Pose]:
        standing = self._cache.placements.get(
            PlacementKey(asset.asset_id, LEVEL_FLOOR.asset_id, Relation.ONTOP)
        )
        footprint = footprint_of(asset, standing[0]) if standing else None
        if not standing or footprint is None:
            return ()
        poses = self._cache.placements.get(PlacementKey(footprint.name, support_id, relation), ())
        pose_box_held = pose_box_asset(footprint, asset, standing[0])
        return [pose_support_box @ pose_box_held for pose_support_box in poses]

    def _spot(self, held: str, target: str, relation: Relation, pose: Pose) -> Spot:
        return Spot(pose, self._link_of(held, target, relation, pose))

    def _link_of(self, held: str, target: str, relation: Relation, pose: Pose) -> str:
        asset = self._scene.asset_of(target)
        if links_with_spots(asset) <= {""}:
            return ""
        return link_under(bounds_of(self._scene.asset_of(held)).box(pose), asset, relation)

    def _patches_for(self, held: str, target: str, relation: Relation) -> tuple[Patch, ...]:
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        key = (one.asset_id, other.asset_id, relation)
        if key not in self._patches:
            self._patches[key] = patches(bounds_of(one), other, relation)
        return self._patches[key]

    def _accept_verified(self, errand: Errand, pose: Pose) -> Pose | None:
        """A pose that was verified with nothing but its support around; it is settled where anything else is near."""
        engine, held, target = self._engine, errand.held, errand.target
        engine.set_pose(held, pose)
        other = engine.penetrates(held, UNDISTURBED_M + TOLERANCE_M, frozenset((target, FLOOR)))
        if other in self._scene.by_name and self._is_deep(held, other):
            return None
        if other:
            return None if engine.penetrates(held) else self._accept_settled(errand)
        # The support's own doors may have moved since.
        if self._is_deep(held, target):
            return None
        return pose if self._holds(errand) else self._accept_settled(errand)

    def _is_deep(self, held: str, other: str) -> bool:
        gap_m = self._engine.gap(held, other, 0.0)
        return gap_m is not None and gap_m < -TOLERANCE_M

    def _accept_settled(self, errand: Errand) -> Pose | None:
        """Let the object go where it is and take the pose where it comes to rest, if all still holds there."""
        settled = self._engine.settle(errand.held)
        if not settled.stable or not self._is_free(errand, settled.pose) or not self._reaches(errand):
            return None
        return settled.pose if self._holds(errand) else None

    def _holds(self, errand: Errand) -> bool:
        return self._relations.holds(errand.relation, errand.held, errand.target)

    def _is_free(self, errand: Errand, pose: Pose) -> bool:
        """Put the object at the pose and tell whether it penetrates nothing there."""
        self._engine.set_pose(errand.held, pose)
        return not self._engine.penetrates(errand.held)

    def _reaches(self, errand: Errand) -> bool:
        return in_reach(self._engine.aabb(errand.held), errand.robot)


def in_reach(box: Aabb, robot: StandPose) -> bool:
    """Whether the arm reaches the nearest point of a box in the plane, and its middle's height."""
    dx = max(box.low_m[0] - robot.x_m, robot.x_m - box.high_m[0], 0.0)
    dy = max(box.low_m[1] - robot.y_m, robot.y_m - box.high_m[1], 0.0)
    height = box.center_m[2]
    return math.hypot(dx, dy) <= ROBOT.reach_m and ROBOT.reach_low_m <= height <= ROBOT.reach_high_m
