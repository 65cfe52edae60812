"""The pose cache of a task's scene: verified poses for what the goals bring together, standing poses that reach for all rows.

Other pairs are left to the executor's live search: a plan that goes its own way costs milliseconds, not minutes here.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from embomatrix.factory.pipeline.pairs import Neighbourhoods, poses_beside
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.live_world import LiveWorld
from embomatrix.sim.physical.prospects import Placing
from embomatrix.sim.physical.survey import prospects
from embomatrix.sim.placing.pose_cache import PLACE_RELATIONS, footprint_placements, standing_poses
from embomatrix.skills.appliance import cold_source, heat_source
from embomatrix.world.bundle import Bundle
from embomatrix.world.poses import Handling, PlacementKey, PoseCache
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from embomatrix.factory.pipeline.pairs import Beside
    from embomatrix.factory.scenes.view import SceneView
    from embomatrix.sim.physical.survey import Foresight
    from embomatrix.sim.placing.pose_cache import PlacementLibrary
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Pose
    from embomatrix.world.poses import StandPose
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

    def __init__(self, scene: Scene, foresight: Foresight | None) -> None:
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

    def prospects(self, poses: PoseCache, placings: Iterable[Placing]) -> PoseCache:
        """A cache of placements and standing poses, with at which of its poses the arm gets with what is placed."""
        return poses if self._foresight is None else prospects(self._world, poses, placings)

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
    return survey.prospects(replace(survey.poses(rows), placements=kept), _placings(view, tasks))


def _placings(view: SceneView, tasks: Sequence[Needs]) -> Iterator[Placing]:
    """What may be placed where: what a goal brings together first, then what is heated or cooled, then the rest."""
    for task in tasks:
        yield from itertools.starmap(Placing, _pairs(view, task.about))
    pairs = [
        (thing, host)
        for task in tasks
        for thing, host in itertools.product(*_portable_and_holders(view, task))
    ]
    pairs.sort(key=lambda pair: not _is_source(view.asset(pair[1])))
    for (thing, host), relation in itertools.product(pairs, PLACE_RELATIONS):
        yield Placing(thing, host, relation)


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
