"""The pose cache of a task's scene: verified poses for what the goals bring together, standing poses that reach for all rows.

Other pairs are left to the executor's live search: a plan that goes its own way costs milliseconds, not minutes here.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.live_world import LiveWorld
from embomatrix.sim.pose_cache import footprint_placements, standing_poses
from embomatrix.world.bundle import Bundle
from embomatrix.world.poses import PlacementKey, PoseCache
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from embomatrix.factory.writer.view import SceneView
    from embomatrix.sim.physical.survey import Foresight
    from embomatrix.sim.pose_cache import PlacementLibrary
    from embomatrix.world.geometry import Pose


@dataclass(frozen=True, slots=True)
class Needs:
    """What one task asks of a cache: ``about`` are the objects that its goal brings together, ``table`` all its rows."""

    about: tuple[str, ...]
    table: tuple[str, ...]


def cache_poses(
    view: SceneView, tasks: Iterable[Needs], library: PlacementLibrary, foresight: Foresight | None, seed: int
) -> PoseCache:
    """Poses for every thing of a task on, or in, whatever of the same task can hold it, and what the arm can do to all rows.

    What a goal brings together has poses of its own; for all other rows of a task's table there are those of their
    footprints. Without ``foresight`` nothing is looked up about the arm.
    """
    scene = view.scene
    placements: dict[PlacementKey, tuple[Pose, ...]] = {}
    rows: dict[str, None] = {}
    for task in tasks:
        rows.update(dict.fromkeys(task.table))
        for thing, host, relation in _pairs(view, task.about):
            key = PlacementKey(view.item(thing).asset_id, view.item(host).asset_id, relation)
            if key not in placements:
                placements[key] = library.poses(view.asset(thing), view.asset(host), relation, seed)
        portable = [name for name in task.table if view.is_portable(name)]
        holders = [
            name
            for name in task.table
            if view.is_surface(name) or view.is_container(name) or view.is_basket(name)
        ]
        placements.update(footprint_placements(scene, portable, holders, library, seed))
    kept = {key: poses for key, poses in placements.items() if poses}
    with contextlib.closing(BulletEngine(scene)) as engine:
        poses = PoseCache(kept, standing_poses(engine, list(rows)))
        if foresight is None:
            return poses
        return foresight.survey(LiveWorld(Bundle(scene, {}, poses), engine), poses, rows)


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
