"""Offline scene analysis: terminal poses, each verified by settling, and standing poses."""

import hashlib
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Final

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.mini_world import MiniWorld, StaticObject
from embomatrix.sim.engine import TOLERANCE_M, PhysicsEngine
from embomatrix.sim.floor.navigation import Navigator
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.candidates import (
    LIFT_M,
    PLACE_RELATIONS,
    beside,
    candidates,
    stands_in,
    surfaces_for,
)
from embomatrix.sim.geometry.footprints import LEVEL_FLOOR, Footprint, box_of, footprint_of
from embomatrix.sim.geometry.surfaces import links_with_surfaces
from embomatrix.sim.placing.snapping import snapped
from embomatrix.sim.state.relations import Relations
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, Aabb, Pose
from embomatrix.world.poses import PlacementKey, PoseCache, StandPose
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation

POSES: Final = 16
"""Verified poses kept per pair."""
TRIES: Final = 40
"""Candidates tried per pair."""
CLASS_POSES: Final = 12
CLASS_POSES_PER_M2: Final = 16
CLASS_POSES_MOST: Final = 40
"""Verified poses kept per footprint class; more on larger surfaces."""
HOPELESS: Final = 12
"""A pair is given up if this many first candidates are unstable."""


class Contents:
    """Content digests of assets, each computed once."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Asset, str]] = {}

    def of(self, asset: Asset) -> str:
        """Return the digest of everything in the asset. The asset is kept, because a freed id could be reused."""
        known = self._known.get(id(asset))
        if known is None:
            # Pose caches draw with seeds from this digest, so it keeps the former name `Part` of `ConvexPart`, and skips
            # the default of a later field.
            content = repr(asset).replace("ConvexPart(", "Part(").replace(", framed=False", "")
            known = (asset, hashlib.sha256(content.encode()).hexdigest())
            self._known[id(asset)] = known
        return known[1]


class PlacementLibrary:
    """Verified placements by the content of both assets: equal pairs of other scenes are not simulated again."""

    def __init__(self) -> None:
        self._pool = ClientPool()
        self._mini = MiniWorld(self._pool)
        self._known: dict[tuple[str, str, Relation, int], tuple[Pose, ...]] = {}
        self._standing: dict[str, Pose | None] = {}
        self._contents = Contents()

    def poses(self, held: Asset, support: Asset, relation: Relation, seed: int) -> tuple[Pose, ...]:
        """Stable poses of ``held`` in the frame of ``support`` with the relation; empty for none.

        Depends on the arguments' content only.
        """
        key = (self._contents.of(held), self._contents.of(support), relation, seed)
        if key not in self._known:
            self._known[key] = tuple(self._verified(held, support, relation, _shift(key), POSES))
        return self._known[key]

    def footprint_poses(
        self, footprint: Footprint, support: Asset, relation: Relation, seed: int
    ) -> tuple[Pose, ...]:
        """Stable, level poses of a class's box in the frame of ``support`` with the relation."""
        key = (footprint.name, self._contents.of(support), relation, seed)
        if key not in self._known:
            box, most = box_of(footprint), _wanted(support, relation)
            found = self._verified(box, support, relation, _shift(key), most)
            on_floor = _on_floor(support)
            bounds = bounds_of(box)
            level: list[Pose] = []
            for pose in found:
                self._mini.lift()
                if self._mini.is_level_under(bounds.box(on_floor @ pose)):
                    level.append(pose)
            self._known[key] = tuple(level)
        return self._known[key]

    def poses_beside(
        self, held: Asset, support: Asset, relation: Relation, neighbour: Aabb
    ) -> tuple[Pose, ...]:
        """Poses right beside a box in the frame of ``support``, for objects that belong next to the one in the box."""
        return tuple(self._stable(held, support, relation, beside(held, support, relation, neighbour), POSES))

    def standing(self, asset: Asset) -> Pose | None:
        """Pose in which the asset stands on a level floor at height 0; None if it falls."""
        key = self._contents.of(asset)
        if key not in self._standing:
            low = bounds_of(asset).box(IDENTITY).low_m[2]
            pose = Pose((0.0, 0.0, LIFT_M - low))
            self._mini.stage(asset, pose, (0.0,) * len(asset.joints), [])
            settled = self._mini.drop(pose)
            self._standing[key] = settled.pose if settled.stable else None
        return self._standing[key]

    def close(self) -> None:
        """Close the physics client. Known placements stay readable."""
        self._mini.close()
        self._pool.close()

    def _verified(
        self, held: Asset, support: Asset, relation: Relation, shift: tuple[float, float], most: int
    ) -> Iterator[Pose]:
        tries = candidates(held, support, relation, shift, max(TRIES, 2 * most))
        return self._stable(held, support, relation, tries, most)

    def _stable(
        self, held: Asset, support: Asset, relation: Relation, tries: Iterator[Pose], most: int
    ) -> Iterator[Pose]:
        """Yield up to ``most`` stable poses. The settling world stays staged while a yielded pose is inspected."""
        first = next(tries, None)
        if first is None:
            return
        pose_world_support = _on_floor(support)
        shut = (0.0,) * len(held.joints)
        still = StaticObject(support, pose_world_support, (0.0,) * len(support.joints))
        self._mini.stage(held, pose_world_support @ first, shut, [still])
        back = pose_world_support.inverse()
        found = 0
        for number, candidate in enumerate(itertools.chain((first,), tries)):
            if found == most or (number == HOPELESS and not found):
                return
            pose = pose_world_support @ candidate
            if self._mini.depth_m(pose) > TOLERANCE_M:
                continue
            settled = self._mini.drop(pose)
            if not settled.stable:
                continue
            rest = back @ settled.pose
            near = snapped(rest)
            if self._mini.depth_m(pose_world_support @ near) <= TOLERANCE_M:
                rest = near
            if stands_in(held, rest, support, relation):
                found += 1
                yield rest


def analyse_scene(engine: PhysicsEngine, library: PlacementLibrary, *, seed: int) -> PoseCache:
    """Analyse a scene: placements of every portable object by its footprint, and standing poses for all objects.

    ``engine`` must hold the scene in its initial state.
    """
    scene = engine.scene
    names = [item.name for item in scene.objects]
    movable = [item.name for item in scene.objects if not item.fixed]
    supports = [name for name in names if links_with_surfaces(scene.asset_of(name))]
    placements = footprint_placements(scene, movable, supports, library, seed)
    return PoseCache(placements, standing_poses(engine, names))


def footprint_placements(
    scene: Scene, movable: Sequence[str], supports: Sequence[str], library: PlacementLibrary, seed: int
) -> dict[PlacementKey, tuple[Pose, ...]]:
    """Poses of the movables' footprint classes on, in and under the supports, and the standing pose of each asset."""
    found: dict[PlacementKey, tuple[Pose, ...]] = {}
    classes: dict[Footprint, None] = {}
    for asset_id in sorted({scene.by_name[name].asset_id for name in movable}):
        asset = scene.assets[asset_id]
        pose = library.standing(asset)
        footprint = footprint_of(asset, pose) if pose is not None else None
        if pose is not None and footprint is not None:
            found[PlacementKey(asset_id, LEVEL_FLOOR, Relation.ONTOP)] = (pose,)
            classes[footprint] = None
    under = sorted({scene.by_name[name].asset_id for name in supports})
    for footprint, support_id, relation in itertools.product(classes, under, PLACE_RELATIONS):
        poses = library.footprint_poses(footprint, scene.assets[support_id], relation, seed)
        if poses:
            found[PlacementKey(footprint.name, support_id, relation)] = poses
    return found


def standing_poses(engine: PhysicsEngine, names: Sequence[str]) -> dict[str, tuple[StandPose, ...]]:
    """Standing poses for each object, in the scene as loaded but with all panels shut."""
    navigator = Navigator(engine, Relations(engine))
    return {name: navigator.stands_past_shut(name, navigator.start) for name in dict.fromkeys(names)}


def _on_floor(support: Asset) -> Pose:
    """Pose of a support on the floor by its box: its real host does not touch placed objects."""
    return Pose((0.0, 0.0, -bounds_of(support).box(IDENTITY).low_m[2]))


def _wanted(support: Asset, relation: Relation) -> int:
    """Number of poses kept for a footprint class on a support."""
    area_m2 = sum(math.prod(surface.size_m) for surface in surfaces_for(support, relation))
    return min(CLASS_POSES_MOST, CLASS_POSES + int(CLASS_POSES_PER_M2 * area_m2))


def _shift(key: tuple[str, str, Relation, int]) -> tuple[float, float]:
    """Two numbers in 0..1 derived from the content of a pair and the seed."""
    digest = hashlib.sha256(":".join(map(str, key)).encode()).digest()
    return (int.from_bytes(digest[:4]) / 2**32, int.from_bytes(digest[4:8]) / 2**32)
