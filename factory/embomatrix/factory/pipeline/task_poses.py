"""The pose cache of a task's scene: verified poses for what the goals bring together, standing poses that reach for all rows.

Other pairs are left to the executor's live search: a plan that goes its own way costs milliseconds, not minutes here.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from embomatrix.factory.scenes.solids import Solids, placed_parts
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.live_world import LiveWorld
from embomatrix.sim.physical.placement_reachability import PlacementQuery
from embomatrix.sim.physical.survey import placement_reachability
from embomatrix.sim.placing.pose_cache import PLACE_RELATIONS, footprint_placements, standing_poses
from embomatrix.skills.appliances import cold_source, heat_source
from embomatrix.world.bundle import Bundle
from embomatrix.world.poses import Handling, PlacementKey, PoseCache
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from embomatrix.factory.scenes.view import SceneView
    from embomatrix.sim.placing.pose_cache import PlacementLibrary
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Aabb, Pose
    from embomatrix.world.poses import StandPose

    Poses = dict[PlacementKey, tuple[Pose, ...]]
    from collections.abc import Sequence

    from embomatrix.sim.physical.survey import ReachabilitySurvey
    from embomatrix.world.geometry import Pose
    from embomatrix.world.scene import Scene


@dataclass(frozen=True, slots=True)
class Needs:
    """What one task asks of a cache.

    ``about`` are the objects that its goal brings together, ``table`` all its rows; ``beside`` are pairs that it wants next to
    one another.
    """

    about: tuple[str, ...]
    table: tuple[str, ...]
    beside: tuple[Beside, ...] = ()


class SceneSurvey:
    """Where the robot stands to work on the objects of a scene, and what the arm can't do there; found out when it is asked.

    Context manager over an engine. Answers do not depend on the order of questions.
    """

    def __init__(self, scene: Scene, foresight: ReachabilitySurvey | None) -> None:
        """Without ``foresight`` nothing is looked up about the arm. Raises EngineError when the scene can't be loaded."""
        self._foresight = foresight
        self._engine = BulletEngine(scene)
        self._world = LiveWorld(Bundle(scene, {}, PoseCache()), self._engine)
        self._stands: dict[str, tuple[StandPose, ...]] = {}
        self._barred: dict[Handling, dict[str, str]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._engine.close()

    def bars(self, handled: Sequence[tuple[Handling, str]]) -> bool:
        """Whether the arm finds no way to do one of some things, each to an object, as the scene begins."""
        self._look_at(name for _, name in handled)
        return any(name in self._barred.get(handling, {}) for handling, name in handled)

    def poses(self, names: Iterable[str]) -> PoseCache:
        """What is known of these objects, as a bundle carries it; no placements."""
        wanted = dict.fromkeys(names)
        self._look_at(wanted)
        barred = {
            handling: {name: found[name] for name in wanted if name in found}
            for handling in Handling
            if (found := self._barred.get(handling, {})).keys() & wanted.keys()
        }
        return PoseCache({}, {name: self._stands[name] for name in wanted}, barred)

    def placement_reachability(self, poses: PoseCache, placings: Iterable[PlacementQuery]) -> PoseCache:
        """A cache of placements and standing poses, with at which of its poses the arm gets with what is placed."""
        return poses if self._foresight is None else placement_reachability(self._world, poses, placings)

    def _look_at(self, names: Iterable[str]) -> None:
        fresh = [name for name in dict.fromkeys(names) if name not in self._stands]
        if not fresh:
            return
        found = PoseCache({}, standing_poses(self._engine, fresh))
        if self._foresight is not None:
            found = self._foresight.survey(self._world, found, fresh)
        self._stands.update(found.stands)
        for handling, others in found.barred.items():
            self._barred.setdefault(handling, {}).update(others)


def cache_poses(
    view: SceneView, tasks: Iterable[Needs], library: PlacementLibrary, survey: SceneSurvey, seed: int
) -> PoseCache:
    """Poses for every thing of a task on, or in, whatever of the same task can hold it, and what the survey knows of all rows.

    What a goal brings together has poses of its own, beside what it must be next to; for all other rows of a task's table
    there are those of their footprints.
    """
    scene, tasks = view.scene, tuple(tasks)
    placements: dict[PlacementKey, tuple[Pose, ...]] = {}
    rows: dict[str, None] = {}
    for task in tasks:
        rows.update(dict.fromkeys(task.table))
        placements.update(poses_beside(view, task.beside, library))
        if any(pair.host for pair in task.beside):
            together = Neighbourhoods(view, library, lambda name: survey.poses([name]).stands[name], seed)
            placements.update(together.poses(task.beside))
        for thing, host, relation in _pairs(view, task.about):
            key = PlacementKey(view.item(thing).asset_id, view.item(host).asset_id, relation)
            if key not in placements:
                placements[key] = library.poses(view.asset(thing), view.asset(host), relation, seed)
        placements.update(footprint_placements(scene, *_portable_and_holders(view, task), library, seed))
    kept = {key: poses for key, poses in placements.items() if poses}
    return survey.placement_reachability(replace(survey.poses(rows), placements=kept), _placings(view, tasks))


def _placings(view: SceneView, tasks: Sequence[Needs]) -> Iterator[PlacementQuery]:
    """What may be placed where: what a goal brings together first, then what is heated or cooled, then the rest."""
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


def _portable_and_holders(view: SceneView, task: Needs) -> tuple[list[str], list[str]]:
    """Rows of a task that can be carried, and those in or on which something can be put."""
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


@dataclass(frozen=True, slots=True)
class Beside:
    """A goal wants one thing next to another: one that stays where it is, or is carried to ``host`` as the first is."""

    thing: str
    neighbour: str
    host: str = ""


def poses_beside(view: SceneView, pairs: Iterable[Beside], library: PlacementLibrary) -> Poses:
    """Poses next to what stays, on or in what that stands on or in."""
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


class Neighbourhoods:
    """Poses of things that are carried to one host, there to stand next to one another."""

    def __init__(
        self,
        view: SceneView,
        library: PlacementLibrary,
        stand_at: Callable[[str], tuple[StandPose, ...]],
        seed: int,
    ) -> None:
        """``stand_at`` tells where the robot stands to work on an object."""
        self._view = view
        self._library = library
        self._stand_at = stand_at
        self._seed = seed
        self._solids = Solids.of_scene(view.scene)
        self._taken: list[Aabb] = []
        self._at: dict[tuple[str, str, Relation], Pose] = {}

    def poses(self, pairs: Iterable[Beside]) -> Poses:
        """Of each pair one pose of the neighbour, and those of the thing beside it: of two alike, one of them."""
        found: Poses = {}
        for pair in pairs:
            for relation in (Relation.ONTOP, Relation.INSIDE):
                for key, poses in self._chosen(pair, relation).items() if pair.host else ():
                    found[key] = (*found.get(key, ()), *poses)
        return found

    def _chosen(self, pair: Beside, relation: Relation) -> Poses:
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

    def _free(self, pair: Beside, asset: Asset, relation: Relation) -> Iterator[Pose]:
        """Poses of an asset on or in the host, the nearest to the robot first, where nothing is yet."""
        found = self._library.poses(asset, self._view.asset(pair.host), relation, self._seed)
        for stand in self._stand_at(pair.host)[:1]:
            frame = self._view.item(pair.host).pose_world_asset

            def away_m(pose: Pose, stand: StandPose = stand, frame: Pose = frame) -> float:
                x, y, _ = (frame @ pose).position_m
                return math.hypot(x - stand.x_m, y - stand.y_m)

            yield from (pose for pose in sorted(found, key=away_m) if self._is_free(pair, asset, pose))

    def _is_free(self, pair: Beside, asset: Asset, pose: Pose) -> bool:
        frame = self._view.item(pair.host).pose_world_asset
        met = self._solids.overlaps(placed_parts(asset, frame @ pose))
        box = self._world_box(pair.host, asset, pose)
        return not met.keys() - {pair.host, pair.thing, pair.neighbour} and not any(
            box.overlaps(other) for other in self._taken
        )

    def _world_box(self, host: str, asset: Asset, pose: Pose) -> Aabb:
        return bounds_of(asset).box(self._view.item(host).pose_world_asset @ pose)
