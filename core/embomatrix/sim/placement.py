"""Where a held object goes when it is placed: the first verified pose that is still free and in reach."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bounds import IDENTITY, bounds_of, parts_of
from embomatrix.sim.candidates import candidates
from embomatrix.sim.engine import FLOOR, TOLERANCE_M
from embomatrix.sim.lineup import Neighbours
from embomatrix.sim.navigation import has_front
from embomatrix.sim.past_leaves import behind_leaves
from embomatrix.sim.repertoire import Repertoire
from embomatrix.sim.spots import is_shut, is_upright, link_frame, links_with_spots
from embomatrix.sim.statics import is_level, rest_pose
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Pose
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    import numpy as np

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.lineup import BoolArray, Lineup
    from embomatrix.sim.relations import Relations
    from embomatrix.sim.repertoire import Spots
    from embomatrix.world.geometry import Aabb
    from embomatrix.world.poses import PoseCache, StandPose

UNDISTURBED_M: Final = 0.005
"""A pose that was verified offline is settled again when anything but its support is this near."""
NEAR_M: Final = UNDISTURBED_M + TOLERANCE_M
"""The margin of a question after what is that near: one about penetration forgives the tolerance."""
LIVE_TRIES: Final = 64
"""Candidates looked at beyond the cached ones."""
LIVE_SETTLES: Final = 8
"""How many of them are simulated at most."""
HIGH_RIM_M: Final = ROBOT.reach_high_m - ROBOT.extent_m / 2
"""Over a rim that is no higher than this the arm lifts whatever it can hold."""


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
    offline or proved by statics, with nothing but its support within 5 mm, or settled now. Doors in the way are the caller's
    to check.
    """

    def __init__(self, engine: PhysicsEngine, relations: Relations, cache: PoseCache) -> None:
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self._repertoire = Repertoire(engine.scene, cache)
        self._reached = cache.reached

    def complete(self) -> Iterator[None]:
        """Find out what everything stands on, and where the parts of what it may be put on are, one asset at a step.

        Work for a process that waits. Changes no answer.
        """
        movable = {item.asset_id for item in self._scene.objects if not item.fixed}
        for asset_id, asset in self._scene.assets.items():
            if asset_id in movable:
                self._repertoire.footprint(asset)
                self._repertoire.base(asset)
                yield
            parts_of(asset).boxes(IDENTITY, (0.0,) * len(asset.joints))
            yield

    def look_up(self, tables: Iterable[Sequence[str]]) -> Iterator[None]:
        """Look up where the things of each table may be put on its supports, one pair of assets at a step.

        Work for a process that waits. Changes no answer.
        """
        return self._repertoire.complete(tables)

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

    def knows(self, held: str, target: str, relation: Relation) -> bool:
        """Whether any pose was verified for the one on, in or under the other."""
        return held != target and any(map(len, self._repertoire.verified(held, target, relation)))

    def verified(
        self, held: str, target: str, relation: Relation, robot: StandPose, most: int
    ) -> tuple[tuple[int, Pose], ...]:
        """As ``choices``, but only of the first set of verified poses that is not empty, with their numbers in that set."""
        errand = Errand(held, target, relation, robot)
        sets = (spots for spots in self._repertoire.verified(held, target, relation) if len(spots))
        spots = next(sets, None)
        if spots is None or held == target or not is_upright(self._engine.pose(target)):
            return ()
        before = self._engine.pose(held)
        try:
            found = self._accepted(errand, spots, self._frames(errand), range(len(spots)))
            return tuple(itertools.islice(found, most))
        finally:
            self._engine.set_pose(held, before)
            self._engine.park(held)

    def _fits(self, held: str, target: str, relation: Relation) -> bool:
        """Whether there is any pose for the one on, in or under the other when nothing else is there."""
        if self.knows(held, target, relation):
            return True
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        return any(True for _ in candidates(one, other, relation, (0.5, 0.5), LIVE_TRIES))

    def _search(self, errand: Errand, rng: np.random.Generator | None) -> Iterator[Pose]:
        """Good poses: of those verified for the pair, then for the footprint's class, then of fresh ones.

        Of the first set that comes first which the arm was seen to get at, while the target is where the scene has it.
        """
        frames = self._frames(errand)
        reached = self._reached_in_set(errand)
        for spots in self._repertoire.verified(errand.held, errand.target, errand.relation):
            if not len(spots):
                continue
            order = range(len(spots)) if rng is None else rng.permutation(len(spots)).tolist()
            if reached is not None and reached < len(spots):
                yield from (pose for _, pose in self._accepted(errand, spots, frames, [reached]))
                order = [number for number in order if number != reached]
            for _, pose in self._accepted(errand, spots, frames, order):
                yield pose
            reached = None
        yield from self._fresh(errand, frames, rng)

    def _reached_in_set(self, errand: Errand) -> int | None:
        """Number of the pose that the arm was seen to get at, in the first set that is not empty."""
        if not self._reached:
            return None
        before = self._scene.by_name[errand.target].pose_world_asset
        if self._engine.pose(errand.target) != before:
            return None
        return self._reached.get(errand.relation, {}).get(errand.held, {}).get(errand.target)

    def _accepted(
        self, errand: Errand, spots: Spots, frames: dict[str, Pose], order: Sequence[int]
    ) -> Iterator[tuple[int, Pose]]:
        """Good ones of a set's poses, each with its number."""
        for number, nearest in self._roomy_first(errand, spots, frames, order):
            found = self._accept_verified(errand, spots.pose(number, frames), nearest)
            if found is not None:
                yield number, found

    def _fresh(
        self, errand: Errand, frames: dict[str, Pose], rng: np.random.Generator | None
    ) -> Iterator[Pose]:
        """Poses for pairs that the analysis did not foresee, and on surfaces that have filled up."""
        shift = (0.5, 0.5) if rng is None else (float(rng.random()), float(rng.random()))
        spots = self._repertoire.fresh(errand.held, errand.target, errand.relation, shift, LIVE_TRIES)
        settles = 0
        for number, nearest in self._roomy_first(errand, spots, frames, range(len(spots))):
            if settles == LIVE_SETTLES:
                return
            proved = self._prove(errand, spots, number, frames)
            if proved is not None:
                yield proved
                continue
            if not self._is_free(errand, spots.pose(number, frames), nearest) or not self._holds(errand):
                continue
            settles += 1
            settled = self._accept_settled(errand)
            if settled is not None:
                yield settled

    def _prove(self, errand: Errand, spots: Spots, number: int, frames: Mapping[str, Pose]) -> Pose | None:
        """Where the thing rests for certain, with nothing but its support within 5 mm; None when it takes a settle to tell."""
        engine, held, target = self._engine, errand.held, errand.target
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        base = self._repertoire.base(one)
        link, local = spots.ride(number)
        if base is None or not is_level(frames[link]):
            return None
        fractions = engine.joints(target)
        rest = rest_pose(one, base, link_frame(other, IDENTITY, fractions, link) @ local, other, fractions)
        if rest is None:
            return None
        pose = engine.pose(target) @ rest
        x, y, z = pose.position_m
        # Looked at a margin higher up, where what lies below its underside, as the table under a sheet, is far enough away.
        engine.set_pose(held, Pose((x, y, z + NEAR_M), pose.quat_xyzw))
        if engine.penetrates(held, NEAR_M, frozenset((target, FLOOR))):
            return None
        engine.set_pose(held, pose)
        return pose if self._holds(errand) and self._reaches(errand) else None

    def _roomy_first(
        self, errand: Errand, spots: Spots, frames: dict[str, Pose], order: Sequence[int]
    ) -> Iterator[tuple[int, str]]:
        """Those in reach: first those around which there is nothing but the target, then the others, the handy ones before.

        With each of the others comes the object that it is most likely to meet. Boxes decide that, so it is cheap; what is
        really free is looked at later. Where something stands for sure is left out.
        """
        if not order:
            return
        held = errand.held
        boxes = spots.lineup(bounds_of(self._scene.asset_of(held)), self._engine.joints(held), frames)
        reached = self._served(errand, boxes, errand.robot)
        for stand in errand.passed_over:
            reached &= ~self._served(errand, boxes, stand)
        flags = reached.tolist()
        rows = [number for number in order if flags[number]]
        if not rows:
            return
        handy = boxes.handy_from(errand.robot).tolist()
        rows.sort(key=lambda number: not handy[number])
        boxes = boxes.at(rows)
        near = self._engine.near(boxes.around().grown(NEAR_M), frozenset((held, errand.target)))
        others = [self._engine.aabb(name) for name in near]
        crowded: list[int] = []
        for place, is_crowded in enumerate(boxes.crowded(others, NEAR_M)):
            if is_crowded:
                crowded.append(place)
            else:
                yield rows[place], ""
        if not crowded:
            return
        boxes, rows = boxes.at(crowded), [rows[place] for place in crowded]
        taken, most = (answers.tolist() for answers in boxes.overlaps(_neighbours(self._engine, near)))
        for number, full, nearest in zip(rows, taken, most, strict=True):
            if not full:
                yield number, near[nearest]

    def _served(self, errand: Errand, boxes: Lineup, stand: StandPose) -> BoolArray:
        """Which boxes, shape (n,), the arm reaches from a standing pose, over the target's rim and past its open doors."""
        target = errand.target
        asset, fractions = self._scene.asset_of(target), self._engine.joints(target)
        reached = boxes.reached_from(stand)
        rim_m = self._engine.aabb(target).high_m[2]
        if errand.relation is Relation.INSIDE and rim_m > HIGH_RIM_M and not has_front(asset):
            reached &= boxes.raised_over(rim_m).reached_from(stand)
        if any(fractions):
            reached &= ~behind_leaves(boxes, asset, self._engine.pose(target), fractions, stand)
        return reached

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

    def _accept_verified(self, errand: Errand, pose: Pose, nearest: str) -> Pose | None:
        """A pose that was verified with nothing but its support around; it is settled where anything else is near."""
        engine, held, target = self._engine, errand.held, errand.target
        engine.set_pose(held, pose)
        if nearest and self._is_deep(held, nearest):
            return None
        other = engine.penetrates(held, NEAR_M, frozenset((target, FLOOR)))
        if other in self._scene.by_name and self._is_deep(held, other):
            return None
        if other:
            return None if engine.penetrates(held) else self._accept_settled(errand)
        # It was verified with both their joints shut: while they are, it is as free of the support as it was then.
        if any((*engine.joints(target), *engine.joints(held))) and self._is_deep(held, target):
            return None
        return pose if self._holds(errand) else self._accept_settled(errand)

    def _is_deep(self, held: str, other: str) -> bool:
        gap_m = self._engine.gap(held, other, 0.0)
        return gap_m is not None and gap_m < -TOLERANCE_M

    def _accept_settled(self, errand: Errand) -> Pose | None:
        """Let the object go where it is and take the pose where it comes to rest, if all still holds there."""
        settled = self._engine.settle(errand.held)
        if not settled.stable or not self._is_free(errand, settled.pose, "") or not self._reaches(errand):
            return None
        return settled.pose if self._holds(errand) else None

    def _holds(self, errand: Errand) -> bool:
        """Whether the relation holds where the object is being tried."""
        match errand.relation:
            case Relation.ONTOP:
                return self._relations.footings.would_be_on(errand.held, errand.target)
            case Relation.INSIDE:
                return self._relations.footings.would_be_in(errand.held, errand.target)
            case _:
                return self._relations.holds(errand.relation, errand.held, errand.target)

    def _is_free(self, errand: Errand, pose: Pose, nearest: str) -> bool:
        """Put the object at the pose and tell whether it penetrates nothing there, ``nearest`` the least."""
        self._engine.set_pose(errand.held, pose)
        if nearest and self._is_deep(errand.held, nearest):
            return False
        return not self._engine.penetrates(errand.held)

    def _reaches(self, errand: Errand) -> bool:
        return in_reach(self._engine.aabb(errand.held), errand.robot)


def _neighbours(engine: PhysicsEngine, names: Sequence[str]) -> Neighbours:
    items = [engine.scene.by_name[name] for name in names]
    links = [engine.scene.assets[item.asset_id].links for item in items]
    return Neighbours.of(
        [engine.aabb(name) for name in names],
        [len(chain) == 1 and len(chain[0].parts) == 1 for chain in links],
        [not item.fixed for item in items],
    )


def in_reach(box: Aabb, robot: StandPose) -> bool:
    """Whether the arm reaches the nearest point of a box in the plane, and its middle's height."""
    dx = max(box.low_m[0] - robot.x_m, robot.x_m - box.high_m[0], 0.0)
    dy = max(box.low_m[1] - robot.y_m, robot.y_m - box.high_m[1], 0.0)
    height = box.center_m[2]
    return math.hypot(dx, dy) <= ROBOT.reach_m and ROBOT.reach_low_m <= height <= ROBOT.reach_high_m
