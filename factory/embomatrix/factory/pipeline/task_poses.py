"""Pose cache of a task's scene: verified poses for objects that goals bring together, and standing poses for all rows.

Other pairs are left to the executor's live search, which takes milliseconds at run time. For pairs that a goal wants
next to each other the cache holds only suitable poses, so that a plan which only names their host reaches the goal too.
The neighbour stays where it is, or both objects are carried to one host; then the neighbour has one pose there, and all
poses of the other lie beside it.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

from embomatrix.factory.assets.solids import Solids, placed_parts
from embomatrix.factory.scenes.view import SceneView
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.candidates import PLACE_RELATIONS
from embomatrix.sim.live_world import LiveWorld
from embomatrix.sim.physical.placement_reachability import PlacementQuery
from embomatrix.sim.physical.survey import ReachabilitySurvey, placement_reachability
from embomatrix.sim.placing.pose_cache import PlacementLibrary, footprint_placements, standing_poses
from embomatrix.skills.appliances import cold_source, heat_source
from embomatrix.world.asset import Asset
from embomatrix.world.bundle import Bundle
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.poses import Handling, PlacementKey, PoseCache, StandPose
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation

Poses = dict[PlacementKey, tuple[Pose, ...]]


@dataclass(frozen=True, slots=True)
class NeighbourPair:
    """Two objects that a goal wants next to each other. The neighbour stays, or both are carried to ``host``."""

    thing: str
    neighbour: str
    host: str = ""


def poses_beside(view: SceneView, pairs: Iterable[NeighbourPair], library: PlacementLibrary) -> Poses:
    """Return poses beside neighbours that stay, on or in the neighbour's host."""
    found: Poses = {}
    for pair in pairs:
        near = view.item(pair.neighbour)
        host, relation = near.host or view.floor_of(near.room), near.relation or Relation.ONTOP
        if pair.host or not host or relation not in (Relation.ONTOP, Relation.INSIDE):
            continue
        frame = view.item(host).pose_world_asset.inverse() @ near.pose_world_asset
        box = bounds_of(view.asset(pair.neighbour)).box(frame)
        key = PlacementKey(view.item(pair.thing).asset_id, view.item(host).asset_id, relation)
        poses = library.poses_beside(view.asset(pair.thing), view.asset(host), relation, box)
        found[key] = (*found.get(key, ()), *poses)
    return found


class PairedPlacements:
    """Poses of objects that are carried to one host and must stand next to each other there."""

    def __init__(
        self,
        view: SceneView,
        library: PlacementLibrary,
        stand_at: Callable[[str], tuple[StandPose, ...]],
        seed: int,
    ) -> None:
        """``stand_at`` returns the robot's standing poses for an object."""
        self._view = view
        self._library = library
        self._stand_at = stand_at
        self._seed = seed
        self._solids = Solids.of_scene(view.scene)
        self._taken: list[Aabb] = []
        self._at: dict[tuple[str, str, Relation], Pose] = {}

    def poses(self, pairs: Iterable[NeighbourPair]) -> Poses:
        """Return one pose of each neighbour, and the poses of the other object beside it.

        For two equal models, one pose each.
        """
        found: Poses = {}
        for pair in pairs:
            for relation in (Relation.ONTOP, Relation.INSIDE):
                for key, poses in self._chosen(pair, relation).items() if pair.host else ():
                    found[key] = (*found.get(key, ()), *poses)
        return found

    def _chosen(self, pair: NeighbourPair, relation: Relation) -> Poses:
        view = self._view
        thing, neighbour, host = (view.asset(name) for name in (pair.thing, pair.neighbour, pair.host))
        known = self._at.get((pair.neighbour, pair.host, relation))
        for pose in (known,) if known else self._free(pair, neighbour, relation):
            beside = self._library.poses_beside(thing, host, relation, bounds_of(neighbour).box(pose))
            near = tuple(other for other in beside if self._is_free(pair, thing, other))
            if not near:
                continue
            self._at[pair.neighbour, pair.host, relation] = pose
            self._at[pair.thing, pair.host, relation] = near[0]
            self._taken += [
                self._world_box(pair.host, asset, at) for asset, at in ((neighbour, pose), (thing, near[0]))
            ]
            key = PlacementKey(thing.asset_id, host.asset_id, relation)
            if thing.asset_id == neighbour.asset_id:
                return {key: (near[0],) if known else (pose, near[0])}
            stays = {PlacementKey(neighbour.asset_id, host.asset_id, relation): (pose,)}
            return {**({} if known else stays), key: near}
        return {}

    def _free(self, pair: NeighbourPair, asset: Asset, relation: Relation) -> Iterator[Pose]:
        """Yield free poses of an asset on or in the host, the nearest to the robot first."""
        found = self._library.poses(asset, self._view.asset(pair.host), relation, self._seed)
        for stand in self._stand_at(pair.host)[:1]:
            frame = self._view.item(pair.host).pose_world_asset

            def away_m(pose: Pose, stand: StandPose = stand, frame: Pose = frame) -> float:
                x, y, _ = (frame @ pose).position_m
                return math.hypot(x - stand.x_m, y - stand.y_m)

            yield from (pose for pose in sorted(found, key=away_m) if self._is_free(pair, asset, pose))

    def _is_free(self, pair: NeighbourPair, asset: Asset, pose: Pose) -> bool:
        frame = self._view.item(pair.host).pose_world_asset
        met = self._solids.overlaps(placed_parts(asset, frame @ pose))
        box = self._world_box(pair.host, asset, pose)
        return not met.keys() - {pair.host, pair.thing, pair.neighbour} and not any(
            box.overlaps(other) for other in self._taken
        )

    def _world_box(self, host: str, asset: Asset, pose: Pose) -> Aabb:
        return bounds_of(asset).box(self._view.item(host).pose_world_asset @ pose)


@dataclass(frozen=True, slots=True)
class PoseNeeds:
    """Requirements of one task for a pose cache.

    ``about`` lists the objects that the goal brings together, ``table`` all rows, ``beside`` the pairs wanted next to
    each other.
    """

    about: tuple[str, ...]
    table: tuple[str, ...]
    beside: tuple[NeighbourPair, ...] = ()


class SceneSurvey:
    """Standing poses of the robot for the objects of a scene, and the handlings that its arm can't do. Computed on demand.

    Context manager of an engine. The answers don't depend on the order of the queries.
    """

    def __init__(self, scene: Scene, foresight: ReachabilitySurvey | None) -> None:
        """Load the scene. Without ``foresight``, the arm is not analysed. Raise EngineError if the scene can't be loaded."""
        self._foresight = foresight
        self._engine = BulletEngine(scene)
        self._world = LiveWorld(Bundle(scene, {}, PoseCache()), self._engine)
        self._stands: dict[str, tuple[StandPose, ...]] = {}
        self._blocked: dict[Handling, dict[str, str]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._engine.close()

    def blocks(self, handled: Sequence[tuple[Handling, str]]) -> bool:
        """True if the arm can't do one of the handlings in the initial scene."""
        self._compute(name for _, name in handled)
        return any(name in self._blocked.get(handling, {}) for handling, name in handled)

    def poses(self, names: Iterable[str]) -> PoseCache:
        """Return standing poses and arm limits of these objects as a bundle carries them, without placements."""
        wanted = dict.fromkeys(names)
        self._compute(wanted)
        blockers = {
            handling: {name: found[name] for name in wanted if name in found}
            for handling in Handling
            if (found := self._blocked.get(handling, {})).keys() & wanted.keys()
        }
        return PoseCache({}, {name: self._stands[name] for name in wanted}, blockers)

    def placement_reachability(self, poses: PoseCache, placings: Iterable[PlacementQuery]) -> PoseCache:
        """Return the cache with the reachable poses of each placed object."""
        return poses if self._foresight is None else placement_reachability(self._world, poses, placings)

    def _compute(self, names: Iterable[str]) -> None:
        fresh = [name for name in dict.fromkeys(names) if name not in self._stands]
        if not fresh:
            return
        found = PoseCache({}, standing_poses(self._engine, fresh))
        if self._foresight is not None:
            found = self._foresight.survey(self._world, found, fresh)
        self._stands.update(found.stands)
        for handling, others in found.arm_blockers.items():
            self._blocked.setdefault(handling, {}).update(others)


def cache_poses(
    view: SceneView, tasks: Iterable[PoseNeeds], library: PlacementLibrary, survey: SceneSurvey, seed: int
) -> PoseCache:
    """Return poses for the objects that each goal brings together, and the survey's results for all rows.

    Pairs that a goal wants next to each other get poses beside each other. Other rows of a task's table get the poses
    of their footprints.
    """
    scene, tasks = view.scene, tuple(tasks)
    placements: dict[PlacementKey, tuple[Pose, ...]] = {}
    rows: dict[str, None] = {}
    for task in tasks:
        rows.update(dict.fromkeys(task.table))
        placements.update(poses_beside(view, task.beside, library))
        if any(pair.host for pair in task.beside):
            together = PairedPlacements(view, library, lambda name: survey.poses([name]).stands[name], seed)
            placements.update(together.poses(task.beside))
        for thing, host, relation in _pairs(view, task.about):
            key = PlacementKey(view.item(thing).asset_id, view.item(host).asset_id, relation)
            if key not in placements:
                placements[key] = library.poses(view.asset(thing), view.asset(host), relation, seed)
        placements.update(footprint_placements(scene, *_portable_and_holders(view, task), library, seed))
    kept = {key: poses for key, poses in placements.items() if poses}
    return survey.placement_reachability(replace(survey.poses(rows), placements=kept), _placings(view, tasks))


def _placings(view: SceneView, tasks: Sequence[PoseNeeds]) -> Iterator[PlacementQuery]:
    """Yield possible placements: those of the goals first, then those at heat and cold sources, then the rest."""
    for task in tasks:
        yield from itertools.starmap(PlacementQuery, _pairs(view, task.about))
    pairs = [
        (thing, host)
        for task in tasks
        for thing, host in itertools.product(*_portable_and_holders(view, task))
    ]
    pairs.sort(key=lambda pair: not _is_source(view.asset(pair[1])))
    for (thing, host), relation in itertools.product(pairs, PLACE_RELATIONS):
        yield PlacementQuery(thing, host, relation)


def _is_source(asset: Asset) -> bool:
    return heat_source(asset) is not None or cold_source(asset) is not None


def _portable_and_holders(view: SceneView, task: PoseNeeds) -> tuple[list[str], list[str]]:
    """Return the rows of a task that can be carried, and the rows that can hold objects."""
    portable = [name for name in task.table if view.is_portable(name)]
    holders = [
        name
        for name in task.table
        if view.is_surface(name) or view.is_container(name) or view.is_basket(name)
    ]
    return portable, holders


def _pairs(view: SceneView, about: tuple[str, ...]) -> Iterator[tuple[str, str, Relation]]:
    for thing in about:
        if not view.is_portable(thing):
            continue
        for host in about:
            if host == thing:
                continue
            if view.is_surface(host):
                yield thing, host, Relation.ONTOP
            if view.is_container(host) or view.is_basket(host):
                yield thing, host, Relation.INSIDE
