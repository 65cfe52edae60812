"""Where a held object goes when it is placed: the first verified pose that is still free and in reach."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Final

from embomatrix.sim.floor.navigation import has_front
from embomatrix.sim.geometry.batch_poses import Neighbours
from embomatrix.sim.geometry.bounds import IDENTITY, bounds_of, parts_of
from embomatrix.sim.geometry.candidates import candidates
from embomatrix.sim.geometry.surfaces import is_shut, is_upright, link_frame, links_with_spots
from embomatrix.sim.joints.behind_panels import behind_leaves
from embomatrix.sim.placing.options import Repertoire
from embomatrix.sim.placing.trial import NEAR_M, Errand, PoseTrial
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    import numpy as np

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.floor.navigation import Navigator
    from embomatrix.sim.geometry.batch_poses import BoolArray, Lineup
    from embomatrix.sim.placing.options import Spots
    from embomatrix.sim.state.relations import Relations
    from embomatrix.world.geometry import Pose
    from embomatrix.world.poses import PoseCache, StandPose

LIVE_TRIES: Final = 64
"""Candidates looked at beyond the cached ones."""
LIVE_SETTLES: Final = 8
"""How many of them are simulated at most."""
LINES_LOOKED_AT: Final = 8
"""How many poses without a line of approach are put off until others were looked at."""
HIGH_RIM_M: Final = ROBOT.reach_high_m - ROBOT.extent_m / 2
"""Over a rim that is no higher than this the arm lifts whatever it can hold."""


class Placer:
    """Finds terminal poses in an engine's present state.

    A pose that is returned has the relation asked for, penetrates nothing, is within the robot's reach and stable: verified
    offline or proved by statics, with nothing but its support within 5 mm, or settled now. Doors in the way are the caller's
    to check.
    """

    def __init__(
        self,
        engine: PhysicsEngine,
        relations: Relations,
        cache: PoseCache,
        navigator: Navigator | None = None,
    ) -> None:
        """With a ``navigator`` poses from which the robot could take the object back come before those that are cut off."""
        self._engine = engine
        self._relations = relations
        self._navigator = navigator
        self._scene = engine.scene
        self._repertoire = Repertoire(engine.scene, cache)
        self._trial = PoseTrial(engine, relations, self._repertoire)
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
            found = tuple(itertools.islice(self._takeable_first(errand, self._search(errand, rng)), most))
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

    def _takeable_first(self, errand: Errand, poses: Iterator[Pose]) -> Iterator[Pose]:
        """Good poses: those that the robot has a line of approach to before some others, unless the arm was asked already."""
        if self._navigator is None or self._reached_in_set(errand) is not None:
            yield from poses
            return
        bounds = bounds_of(self._scene.asset_of(errand.held))
        own = [errand.held]
        if errand.relation is not Relation.UNDER:
            own += [errand.target, *self._relations.hosts_of(errand.target)]
        cut_off: list[Pose] = []
        for pose in poses:
            if self._navigator.line_would_be_clear(errand.robot, bounds.box(pose), own):
                yield pose
            else:
                cut_off.append(pose)
                if len(cut_off) == LINES_LOOKED_AT:
                    break
        yield from cut_off
        yield from poses

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
            found = self._trial.verified(errand, spots.pose(number, frames), nearest)
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
            proved = self._trial.proved(errand, spots, number, frames)
            if proved is not None:
                yield proved
                continue
            if not self._trial.is_free(errand, spots.pose(number, frames), nearest) or not self._trial.holds(
                errand
            ):
                continue
            settles += 1
            settled = self._trial.settled(errand)
            if settled is not None:
                yield settled

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


def _neighbours(engine: PhysicsEngine, names: Sequence[str]) -> Neighbours:
    items = [engine.scene.by_name[name] for name in names]
    links = [engine.scene.assets[item.asset_id].links for item in items]
    return Neighbours.of(
        [engine.aabb(name) for name in names],
        [len(chain) == 1 and len(chain[0].parts) == 1 for chain in links],
        [not item.fixed for item in items],
    )
