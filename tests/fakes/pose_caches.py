"""Pose caches of small scenes."""

from __future__ import annotations

import contextlib
import itertools
from typing import TYPE_CHECKING

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.geometry.candidates import PLACE_RELATIONS
from embomatrix.sim.placing.pose_cache import PlacementLibrary, standing_poses
from embomatrix.world.poses import PlacementKey, PoseCache

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.world.geometry import Pose
    from embomatrix.world.scene import Scene


def build_pose_cache(
    scene: Scene,
    movable: Sequence[str],
    supports: Sequence[str],
    *,
    seed: int,
    engine: PhysicsEngine | None = None,
    library: PlacementLibrary | None = None,
) -> PoseCache:
    """Return verified placements of every movable object on every support, and standing poses for all of them.

    ``engine`` must hold this scene in its initial state; without an engine the scene is loaded. Pairs without a stable
    pose have no entry. Raises EngineError for an invalid scene, KeyError for an unknown name.
    """
    with contextlib.ExitStack() as owned:
        if library is None:
            library = owned.enter_context(contextlib.closing(PlacementLibrary()))
        if engine is None:
            engine = owned.enter_context(contextlib.closing(BulletEngine(scene)))
        return PoseCache(
            _placements(scene, movable, supports, library, seed),
            standing_poses(engine, (*movable, *supports)),
        )


def _placements(
    scene: Scene, movable: Sequence[str], supports: Sequence[str], library: PlacementLibrary, seed: int
) -> dict[PlacementKey, tuple[Pose, ...]]:
    held = sorted({scene.by_name[name].asset_id for name in movable})
    under = sorted({scene.by_name[name].asset_id for name in supports})
    found: dict[PlacementKey, tuple[Pose, ...]] = {}
    for held_id, support_id, relation in itertools.product(held, under, PLACE_RELATIONS):
        poses = library.poses(scene.assets[held_id], scene.assets[support_id], relation, seed)
        if poses:
            found[PlacementKey(held_id, support_id, relation)] = poses
    return found
