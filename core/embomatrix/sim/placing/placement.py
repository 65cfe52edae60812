"""Placement of a held object: the first verified pose that is still free and in reach."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import numpy as np

from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.floor.navigation import Navigator, has_front
from embomatrix.sim.geometry.batch_poses import BoolArray, Neighbours, PoseBoxes
from embomatrix.sim.geometry.bounds import bounds_of, parts_of
from embomatrix.sim.geometry.candidates import candidates
from embomatrix.sim.geometry.surfaces import is_shut, is_upright, link_frame, links_with_surfaces
from embomatrix.sim.joints.behind_panels import behind_panels
from embomatrix.sim.placing.options import CandidatePoses, PlacementOptions
from embomatrix.sim.placing.trial import NEAR_M, PlacementRequest, PoseTrial
from embomatrix.sim.state.relations import Relations
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import IDENTITY, Pose
from embomatrix.world.poses import PoseCache, StandPose
from embomatrix.world.state import Relation

LIVE_TRIES: Final = 64
"""Candidates tried beyond the cached ones."""
LIVE_SETTLES: Final = 8
"""Most of these candidates that are simulated."""
LINES_LOOKED_AT: Final = 8
"""Poses without a line of approach that are deferred behind others."""
HIGH_RIM_M: Final = ROBOT.reach_high_m - ROBOT.extent_m / 2
"""Highest rim over which the arm lifts any object it can hold."""


class Placer:
    """Finds terminal poses in an engine's present state.

    A returned pose has the requested relation, penetrates nothing, is within the robot's reach and is stable: verified offline
    or proved by statics with nothing but its support within 5 mm, or settled now. The caller checks for doors in the way.
    """

    def __init__(
        self,
        engine: PhysicsEngine,
        relations: Relations,
        cache: PoseCache,
        navigator: Navigator | None = None,
    ) -> None:
        """``navigator`` puts poses first from which the robot could take the object back."""
        self._engine = engine
        self._relations = relations
        self._navigator = navigator
        self._scene = engine.scene
        self._options = PlacementOptions(engine.scene, cache)
        self._trial = PoseTrial(engine, relations, self._options)
        self._reached = cache.reached

    def warm_up(self) -> Iterator[None]:
        """Compute footprints, contact polygons and part boxes, one asset per step. Changes no answer."""
        movable = {item.asset_id for item in self._scene.objects if not item.fixed}
        for asset_id, asset in self._scene.assets.items():
            if asset_id in movable:
                self._options.footprint(asset)
                self._options.base(asset)
                yield
            parts_of(asset).boxes(IDENTITY, (0.0,) * len(asset.joints))
            yield

    def look_up(self, tables: Iterable[Sequence[str]]) -> Iterator[None]:
        """Look up placements of the objects of each table on its supports, one pair per step. Changes no answer."""
        return self._options.warm_up(tables)

    def find(
        self,
        held: str,
        target: str,
        relation: Relation,
        robot: StandPose,
        rng: np.random.Generator | None = None,
        excluded_stands: tuple[StandPose, ...] = (),
    ) -> Pose | FailureReason:
        """Return a pose for a parked object on, in or under another, or the reason for none.

        ``rng`` orders the poses; without one the cache's order holds. Poses within reach of ``excluded_stands`` are skipped.
        The world is left unchanged. Raises EngineError for unknown names.
        """
        found = self.choices(held, target, relation, robot, rng, most=1, excluded_stands=excluded_stands)
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
        excluded_stands: tuple[StandPose, ...] = (),
    ) -> tuple[Pose, ...] | FailureReason:
        """First poses in the order of ``find``, at least one and at most ``most``."""
        if held == target or self._engine.is_parked(target):
            return FailureReason.PLACE_ON_ITSELF
        fails = FailureReason.NO_CAVITY if relation is Relation.INSIDE else FailureReason.NO_SURFACE
        if not is_upright(self._engine.pose(target)):
            return fails
        before = self._engine.pose(held)
        request = PlacementRequest(held, target, relation, robot, excluded_stands)
        try:
            found = tuple(itertools.islice(self._takeable_first(request, self._search(request, rng)), most))
        finally:
            self._engine.set_pose(held, before)
            self._engine.park(held)
        if found:
            return found
        return FailureReason.NO_FREE_POSE if self._fits(held, target, relation) else fails

    def has_verified(self, held: str, target: str, relation: Relation) -> bool:
        """Return True if any pose was verified for this pair and relation."""
        return held != target and any(map(len, self._options.verified(held, target, relation)))

    def verified(
        self, held: str, target: str, relation: Relation, robot: StandPose, most: int
    ) -> tuple[tuple[int, Pose], ...]:
        """Apply ``choices`` to the first non-empty set of verified poses; each pose comes with its number in the set."""
        request = PlacementRequest(held, target, relation, robot)
        sets = (options for options in self._options.verified(held, target, relation) if len(options))
        options = next(sets, None)
        if options is None or held == target or not is_upright(self._engine.pose(target)):
            return ()
        before = self._engine.pose(held)
        try:
            found = self._accepted(request, options, self._frames(request), range(len(options)))
            return tuple(itertools.islice(found, most))
        finally:
            self._engine.set_pose(held, before)
            self._engine.park(held)

    def _fits(self, held: str, target: str, relation: Relation) -> bool:
        """Return True if a pose exists when nothing else is there."""
        if self.has_verified(held, target, relation):
            return True
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        return any(True for _ in candidates(one, other, relation, (0.5, 0.5), LIVE_TRIES))

    def _search(self, request: PlacementRequest, rng: np.random.Generator | None) -> Iterator[Pose]:
        """Accepted poses: verified for the pair, then for the footprint class, then fresh ones.

        In the first set, the pose that the arm reached in the analysis comes first while the target is where the scene has it.
        """
        frames = self._frames(request)
        reached = self._reached_in_set(request)
        for options in self._options.verified(request.held, request.target, request.relation):
            if not len(options):
                continue
            order = range(len(options)) if rng is None else rng.permutation(len(options)).tolist()
            if reached is not None and reached < len(options):
                yield from (pose for _, pose in self._accepted(request, options, frames, [reached]))
                order = [number for number in order if number != reached]
            for _, pose in self._accepted(request, options, frames, order):
                yield pose
            reached = None
        yield from self._fresh(request, frames, rng)

    def _takeable_first(self, request: PlacementRequest, poses: Iterator[Pose]) -> Iterator[Pose]:
        """Poses with a line of approach before a few others, unless the arm was checked already."""
        if self._navigator is None or self._reached_in_set(request) is not None:
            yield from poses
            return
        bounds = bounds_of(self._scene.asset_of(request.held))
        own = [request.held]
        if request.relation is not Relation.UNDER:
            own += [request.target, *self._relations.hosts_of(request.target)]
        cut_off: list[Pose] = []
        for pose in poses:
            if self._navigator.line_would_be_clear(request.robot, bounds.box(pose), own):
                yield pose
            else:
                cut_off.append(pose)
                if len(cut_off) == LINES_LOOKED_AT:
                    break
        yield from cut_off
        yield from poses

    def _reached_in_set(self, request: PlacementRequest) -> int | None:
        """Number of the pose that the arm reached in the analysis, in the first non-empty set."""
        if not self._reached:
            return None
        before = self._scene.by_name[request.target].pose_world_asset
        if self._engine.pose(request.target) != before:
            return None
        return self._reached.get(request.relation, {}).get(request.held, {}).get(request.target)

    def _accepted(
        self,
        request: PlacementRequest,
        options: CandidatePoses,
        frames: dict[str, Pose],
        order: Sequence[int],
    ) -> Iterator[tuple[int, Pose]]:
        """Accepted poses of a set, each with its number."""
        for number, nearest in self._roomy_first(request, options, frames, order):
            found = self._trial.verified(request, options.pose(number, frames), nearest)
            if found is not None:
                yield number, found

    def _fresh(
        self, request: PlacementRequest, frames: dict[str, Pose], rng: np.random.Generator | None
    ) -> Iterator[Pose]:
        """Poses for pairs that the analysis did not cover, and on surfaces that have filled up."""
        shift = (0.5, 0.5) if rng is None else (float(rng.random()), float(rng.random()))
        options = self._options.fresh(request.held, request.target, request.relation, shift, LIVE_TRIES)
        settles = 0
        for number, nearest in self._roomy_first(request, options, frames, range(len(options))):
            if settles == LIVE_SETTLES:
                return
            proved = self._trial.proved(request, options, number, frames)
            if proved is not None:
                yield proved
                continue
            if not self._trial.is_free(
                request, options.pose(number, frames), nearest
            ) or not self._trial.holds(request):
                continue
            settles += 1
            settled = self._trial.settled(request)
            if settled is not None:
                yield settled

    def _roomy_first(
        self,
        request: PlacementRequest,
        options: CandidatePoses,
        frames: dict[str, Pose],
        order: Sequence[int],
    ) -> Iterator[tuple[int, str]]:
        """Candidates in reach: first those with nothing but the target around, then the others; handy ones lead each group.

        Each of the others comes with the object it most likely meets. This coarse test uses boxes only; candidates that
        certainly collide are left out.
        """
        if not order:
            return
        held = request.held
        boxes = options.world_boxes(bounds_of(self._scene.asset_of(held)), self._engine.joints(held), frames)
        reached = self._served(request, boxes, request.robot)
        for stand in request.excluded_stands:
            reached &= ~self._served(request, boxes, stand)
        flags = reached.tolist()
        rows = [number for number in order if flags[number]]
        if not rows:
            return
        handy = boxes.handy_from(request.robot).tolist()
        rows.sort(key=lambda number: not handy[number])
        boxes = boxes.at(rows)
        near = self._engine.near(boxes.around().grown(NEAR_M), frozenset((held, request.target)))
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

    def _served(self, request: PlacementRequest, boxes: PoseBoxes, stand: StandPose) -> BoolArray:
        """Tell for each box, shape (n,), if the arm reaches it over the target's rim and past its open doors."""
        target = request.target
        asset, fractions = self._scene.asset_of(target), self._engine.joints(target)
        reached = boxes.reached_from(stand)
        rim_m = self._engine.aabb(target).high_m[2]
        if request.relation is Relation.INSIDE and rim_m > HIGH_RIM_M and not has_front(asset):
            reached &= boxes.raised_over(rim_m).reached_from(stand)
        if any(fractions):
            reached &= ~behind_panels(boxes, asset, self._engine.pose(target), fractions, stand)
        return reached

    def _frames(self, request: PlacementRequest) -> dict[str, Pose]:
        """Frame of each link of the target that can carry objects; shut drawers are left out."""
        asset = self._scene.asset_of(request.target)
        pose, fractions = self._engine.pose(request.target), self._engine.joints(request.target)
        shut = {
            item.link
            for item in asset.interiors
            if item.link and request.relation is Relation.INSIDE and is_shut(asset, item, fractions)
        }
        links = ({""} | links_with_surfaces(asset)) - shut
        return {link: link_frame(asset, pose, fractions, link) for link in sorted(links)}


def _neighbours(engine: PhysicsEngine, names: Sequence[str]) -> Neighbours:
    items = [engine.scene.by_name[name] for name in names]
    links = [engine.scene.assets[item.asset_id].links for item in items]
    return Neighbours.of(
        [engine.aabb(name) for name in names],
        [len(chain) == 1 and len(chain[0].parts) == 1 for chain in links],
        [not item.fixed for item in items],
    )
