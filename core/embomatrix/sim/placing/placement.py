"""Placement of a held object: the first verified pose that is still free and in reach."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Final, TypeVar

import numpy as np

from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.floor.navigation import Navigator
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.candidates import PLACE_RELATIONS, YAWS, candidates
from embomatrix.sim.geometry.surfaces import is_upright, links_with_surfaces
from embomatrix.sim.placing.beside import BesideSearch
from embomatrix.sim.placing.loaded_places import MovedObjects, loaded_places
from embomatrix.sim.placing.options import PlacementOptions
from embomatrix.sim.placing.search import LIVE_TRIES, PlacementSearch, link_frames
from embomatrix.sim.state.relations import Relations
from embomatrix.skills.failure import FailureReason
from embomatrix.world.geometry import IDENTITY, Pose
from embomatrix.world.poses import PoseCache, StandPose
from embomatrix.world.state import Relation

T = TypeVar("T")

LINES_LOOKED_AT: Final = 8
"""Poses without a line of approach that are deferred behind others."""


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
        self.options = PlacementOptions(engine.scene, cache)
        self._reached = cache.reached
        self._moved = MovedObjects(engine)

    def warm_up(self) -> Iterator[None]:
        """Compute footprints, contact polygons and part boxes, one asset per step. Changes no answer."""
        movable = {item.asset_id for item in self._scene.objects if not item.fixed}
        for asset_id in dict.fromkeys(item.asset_id for item in self._scene.objects):
            asset = self._scene.assets[asset_id]
            if asset_id in movable:
                self.options.footprints[asset_id]
                self.options.bases[asset_id]
                for yaw in YAWS:
                    bounds_of(asset).box(Pose.from_xyz_yaw(0.0, 0.0, 0.0, yaw))
                yield
            bounds_of(asset).part_boxes(IDENTITY, (0.0,) * len(asset.joints))
            yield

    def warm_up_pairs(self, tables: Iterable[Sequence[str]]) -> Iterator[None]:
        """Look around the verified poses for the objects and supports of each table, one pair per step. Changes no answer.

        Only the unchanged scene is looked at. Fresh poses for the pairs without verified ones follow.
        """
        pairs = [
            (held, target)
            for table in tables
            for target in self._supports(table)
            for held in self._movable(table)
        ]
        for held, target in pairs:
            if not self._engine.state_bytes():
                self._look_around(held, target)
            yield
        for (held, target), relation in itertools.product(pairs, (Relation.ONTOP, Relation.INSIDE)):
            if not self.has_verified(held, target, relation):
                self.options.warm_up_fresh(held, target, relation)
                yield

    def look_into(self, target: str, tables: Iterable[Sequence[str]], robot: StandPose) -> None:
        """Look around the verified poses on a support of a scene in which only this support was opened.

        The robot will probably stand at ``robot``.
        """
        for table in tables:
            if target in self._supports(table):
                for held in self._movable(table):
                    self._look_around(held, target, robot)

    def _movable(self, table: Sequence[str]) -> list[str]:
        return [name for name in table if not self._scene.by_name[name].fixed]

    def _supports(self, table: Sequence[str]) -> list[str]:
        return [name for name in table if links_with_surfaces(self._scene.asset_of(name))]

    def _look_around(self, held: str, target: str, robot: StandPose | None = None) -> None:
        """Look around the verified poses of a pair now, and keep what was found for later states of the scene."""
        engine, fractions = self._engine, self._scene.by_name[held].joints
        for relation in PLACE_RELATIONS:
            support = (target, relation, fractions, engine.joints(target))
            for options in self.options.verified(held, target, relation):
                if support not in options.as_loaded:
                    frames = link_frames(engine, target, relation)
                    found = loaded_places(engine, target, options.places, fractions, frames)
                    options.as_loaded[support] = found
                    if robot is not None:
                        self._search(held, target, relation, robot).served(found)

    def find(
        self,
        held: str,
        target: str,
        relation: Relation,
        robot: StandPose,
        rng: np.random.Generator | None = None,
        excluded_stands: tuple[StandPose, ...] = (),
    ) -> Pose | FailureReason:
        """Return a pose for a parked object on, in, under or next to another, or the reason for none.

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
        if relation is Relation.NEXTTO:
            return self._choices_beside(held, target, robot, rng, most, excluded_stands)
        fails = FailureReason.NO_CAVITY if relation is Relation.INSIDE else FailureReason.NO_SURFACE
        if not is_upright(self._engine.pose(target)):
            return fails
        reached = self._reached_in_set(held, target, relation)
        search = self._search(held, target, relation, robot, excluded_stands)
        poses = search.poses(rng, reached)
        found = self._first(most, held, poses if reached is not None else self._takeable_first(search, poses))
        if found:
            return found
        return FailureReason.NO_FREE_POSE if self._fits(held, target, relation) else fails

    def _choices_beside(
        self,
        held: str,
        target: str,
        robot: StandPose,
        rng: np.random.Generator | None,
        most: int,
        excluded_stands: tuple[StandPose, ...],
    ) -> tuple[Pose, ...] | FailureReason:
        search = self._beside(held, target, robot, excluded_stands)
        found = self._first(most, held, self._takeable_first(search, search.poses(rng)))
        if found:
            return found
        return FailureReason.NO_FREE_POSE if search.fits() else FailureReason.NO_SURFACE

    def hindrance(
        self, held: str, target: str, relation: Relation, stands: Sequence[StandPose]
    ) -> tuple[FailureReason, str]:
        """Reason why ``find`` found no pose from any of these standing poses, and the object in the way; "" for none.

        The first standing pose from which places are in reach counts.
        """
        found = (FailureReason.PLACES_OUT_OF_REACH, "")
        before = self._engine.pose(held)
        try:
            for stand in stands:
                if relation is Relation.NEXTTO:
                    answer = self._beside(held, target, stand).hindrance()
                else:
                    answer = self._search(held, target, relation, stand).hindrance()
                if answer[0] is FailureReason.NO_FREE_POSE:
                    return answer
                if answer[0] is FailureReason.PLACES_BEHIND_DOOR:
                    found = answer
        finally:
            self._engine.set_pose(held, before)
            self._engine.park(held)
        return found

    def has_verified(self, held: str, target: str, relation: Relation) -> bool:
        """Return True if any pose was verified for this pair and relation."""
        return held != target and any(True for _ in self.options.verified(held, target, relation))

    def verified(
        self, held: str, target: str, relation: Relation, robot: StandPose, most: int
    ) -> tuple[tuple[int, Pose], ...]:
        """Apply ``choices`` to the first non-empty set of verified poses; each pose comes with its number in the set."""
        options = next(self.options.verified(held, target, relation), None)
        if options is None or held == target or not is_upright(self._engine.pose(target)):
            return ()
        search = self._search(held, target, relation, robot)
        return self._first(most, held, search.accepted(options, range(len(options))))

    def _first(self, most: int, held: str, found: Iterator[T]) -> tuple[T, ...]:
        """First results of a search, which moves the held object. The object is parked again afterwards."""
        before = self._engine.pose(held)
        try:
            return tuple(itertools.islice(found, most))
        finally:
            if not self._engine.is_parked(held):
                self._engine.set_pose(held, before)
                self._engine.park(held)

    def _search(
        self,
        held: str,
        target: str,
        relation: Relation,
        robot: StandPose,
        excluded: tuple[StandPose, ...] = (),
    ) -> PlacementSearch:
        return PlacementSearch(
            self._engine,
            self._relations,
            self.options,
            self._moved,
            held,
            target,
            relation,
            robot,
            excluded,
        )

    def _beside(
        self, held: str, target: str, robot: StandPose, excluded: tuple[StandPose, ...] = ()
    ) -> BesideSearch:
        host = self._relations.host_of(target)
        around = self._search(held, host.name, host.relation, robot) if host is not None else None
        return BesideSearch(
            self._engine, self._relations, self.options, held, target, robot, around, excluded
        )

    def _fits(self, held: str, target: str, relation: Relation) -> bool:
        """Return True if a pose exists when nothing else is there."""
        if self.has_verified(held, target, relation):
            return True
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        return any(True for _ in candidates(one, other, relation, (0.5, 0.5), LIVE_TRIES))

    def _takeable_first(
        self, search: PlacementSearch | BesideSearch, poses: Iterator[Pose]
    ) -> Iterator[Pose]:
        """Poses with a line of approach before a few others."""
        if self._navigator is None:
            yield from poses
            return
        bounds = bounds_of(self._scene.asset_of(search.held))
        own = [search.held]
        if search.relation is not Relation.UNDER:
            own += [search.target, *self._relations.hosts_of(search.target)]
        cut_off: list[Pose] = []
        for pose in poses:
            if self._navigator.line_would_be_clear(search.robot, bounds.box(pose), own):
                yield pose
            else:
                cut_off.append(pose)
                if len(cut_off) == LINES_LOOKED_AT:
                    break
        yield from cut_off
        yield from poses

    def _reached_in_set(self, held: str, target: str, relation: Relation) -> int | None:
        """Number of the pose that the arm reached in the analysis, in the first non-empty set.

        None if the target is no longer where the scene has it.
        """
        if self._engine.pose(target) != self._scene.by_name[target].pose_world_asset:
            return None
        return self._reached.get(relation, {}).get(held, {}).get(target)
