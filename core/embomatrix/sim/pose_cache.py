"""Offline scene analysis: terminal poses for every pair of assets, each verified by settling, and standing poses."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bounds import AssetBounds
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.bullet.mini_world import MiniWorld, Still
from embomatrix.sim.candidates import candidates, stands_in
from embomatrix.sim.engine import TOLERANCE_M
from embomatrix.sim.navigation import Navigator
from embomatrix.sim.relations import Relations
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import PlacementKey, PoseCache, StandPose
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.world.asset import Asset
    from embomatrix.world.scene import Scene

PLACE_RELATIONS: Final = (Relation.ONTOP, Relation.INSIDE, Relation.UNDER)
POSES: Final = 16
"""Verified poses that are kept for a pair."""
TRIES: Final = 40
"""Candidates that are looked at for a pair."""
HOPELESS: Final = 12
"""A pair none of whose first candidates is stable is given up."""


class PlacementLibrary:
    """Verified placements by the content of the two assets: equal pairs of other scenes are not simulated again."""

    def __init__(self, pool: ClientPool | None = None) -> None:
        """``pool`` lends the client to settle in; without one the library opens its own and closes it in the end."""
        self._owns_pool = pool is None
        self._pool = pool or ClientPool()
        self._mini = MiniWorld(self._pool)
        self._known: dict[tuple[str, str, Relation, int], tuple[Pose, ...]] = {}
        self._contents: dict[int, tuple[Asset, str]] = {}

    def poses(self, held: Asset, support: Asset, relation: Relation, seed: int) -> tuple[Pose, ...]:
        """Poses of ``held`` in the frame of ``support``, each stable and in the relation; empty when none was found.

        Depends on nothing but the arguments' content.
        """
        key = (self._content(held), self._content(support), relation, seed)
        if key not in self._known:
            self._known[key] = tuple(self._verified(held, support, relation, _shift(key)))
        return self._known[key]

    def close(self) -> None:
        """Give the client back. Known placements can still be read."""
        self._mini.close()
        if self._owns_pool:
            self._pool.close()

    def _verified(
        self, held: Asset, support: Asset, relation: Relation, shift: tuple[float, float]
    ) -> Iterator[Pose]:
        tries = candidates(held, support, relation, shift, TRIES)
        first = next(tries, None)
        if first is None:
            return
        # The support stands on the floor by its box: what it really stands on does not touch what is placed.
        pose_world_support = Pose((0.0, 0.0, -AssetBounds(support).box(Pose((0.0, 0.0, 0.0))).low_m[2]))
        shut = (0.0,) * len(held.joints)
        still = Still(support, pose_world_support, (0.0,) * len(support.joints))
        self._mini.stage(held, pose_world_support @ first, shut, [still])
        back = pose_world_support.inverse()
        found = 0
        for number, candidate in enumerate(itertools.chain((first,), tries)):
            if found == POSES or (number == HOPELESS and not found):
                return
            pose = pose_world_support @ candidate
            if self._mini.depth_m(pose) > TOLERANCE_M:
                continue
            settled = self._mini.drop(pose)
            if settled.stable and stands_in(held, back @ settled.pose, support, relation):
                found += 1
                yield back @ settled.pose

    def _content(self, asset: Asset) -> str:
        """Digest of everything in the asset. The asset is kept, so that its id can't pass to another one."""
        known = self._contents.get(id(asset))
        if known is None:
            known = (asset, hashlib.sha256(repr(asset).encode()).hexdigest())
            self._contents[id(asset)] = known
        return known[1]


def build_pose_cache(
    scene: Scene,
    movable: Sequence[str],
    supports: Sequence[str],
    *,
    seed: int,
    engine: PhysicsEngine | None = None,
    library: PlacementLibrary | None = None,
) -> PoseCache:
    """Placements of every movable object's asset on, in and under every support's, and standing poses for all of them.

    ``engine`` must hold this scene in its initial state; without one the scene is loaded for the occasion. Pairs without a
    stable pose have no entry. Raises EngineError when the scene is not valid, KeyError for an unknown name.
    """
    with contextlib.ExitStack() as owned:
        if library is None:
            library = owned.enter_context(contextlib.closing(PlacementLibrary()))
        if engine is None:
            engine = owned.enter_context(contextlib.closing(BulletEngine(scene)))
        return PoseCache(
            _placements(scene, movable, supports, library, seed), _stands(engine, (*movable, *supports))
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


def _stands(engine: PhysicsEngine, names: Sequence[str]) -> dict[str, tuple[StandPose, ...]]:
    navigator = Navigator(engine, Relations(engine))
    return {name: navigator.stands(name, navigator.start) for name in dict.fromkeys(names)}


def _shift(key: tuple[str, str, Relation, int]) -> tuple[float, float]:
    """Two numbers in 0..1 that follow from the content of a pair and the seed."""
    digest = hashlib.sha256(":".join(map(str, key)).encode()).digest()
    return (int.from_bytes(digest[:4]) / 2**32, int.from_bytes(digest[4:8]) / 2**32)
