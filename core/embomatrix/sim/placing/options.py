"""Candidate poses of one object on, in or under another: verified poses and fresh ones, independent of the world's state."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from embomatrix.sim.caches import BoundedCache
from embomatrix.sim.geometry.batch_poses import PoseSet
from embomatrix.sim.geometry.behind_panels import Barrier, barriers
from embomatrix.sim.geometry.bounds import ASSETS_KEPT, bounds_of
from embomatrix.sim.geometry.candidates import patches, spread_over
from embomatrix.sim.geometry.footprints import LEVEL_FLOOR, footprint_of, pose_box_asset
from embomatrix.sim.geometry.statics import Base, base_of
from embomatrix.sim.geometry.surfaces import link_under, links_with_surfaces
from embomatrix.sim.placing.loaded_places import LoadedPlaces
from embomatrix.world.geometry import IDENTITY, FloatArray, Pose, Vec2
from embomatrix.world.placements import pose_rows, rows_of
from embomatrix.world.poses import PlacementKey, PoseCache
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation

PAIRS_KEPT: Final = 65536
"""Pairs of assets with cached poses: more than a scene has."""
BARRIERS_KEPT: Final = 256
"""Open objects with cached barriers, 2 kB each."""

SupportAsLoaded = tuple[str, Relation, tuple[float, ...], tuple[float, ...]]
"""Support where the scene has it, the relation to it, and the joint positions of the held object and of the support."""


@dataclass(frozen=True, slots=True)
class CandidatePoses:
    """Poses of one asset in the frames of a support's links: as arrays, and exactly by their number."""

    places: PoseSet
    exact: Callable[[int], Pose]
    as_loaded: dict[SupportAsLoaded, LoadedPlaces] = field(default_factory=dict)
    """Places in the scene as loaded, as far as they were looked at."""

    def __len__(self) -> int:
        return len(self.places.link_of)

    def pose(self, number: int, frames: Mapping[str, Pose]) -> Pose:
        """Pose in the world. Raises KeyError if its link has no frame."""
        return frames[self.link(number)] @ self.exact(number)

    def link(self, number: int) -> str:
        """Link that carries a pose."""
        links = self.places.links
        return links[0] if len(links) == 1 else links[int(self.places.link_of[number])]


@dataclass(frozen=True, slots=True)
class PatchSet:
    """Patches for a pair as arrays, centres of shape (p, 3) and rooms of shape (p, 2), and the poses in their middles."""

    centers_m: FloatArray
    rooms_m: FloatArray
    yaws: tuple[float, ...]
    middles: PoseSet


class PlacementOptions:
    """Candidate poses from a pose cache and from the surfaces of a scene's assets."""

    def __init__(self, scene: Scene, cache: PoseCache) -> None:
        self._scene = scene
        self._cache = cache
        self._of_pair = BoundedCache(PAIRS_KEPT, self._find_of_pair)
        self._of_class = BoundedCache(PAIRS_KEPT, self._find_of_class)
        self._patches = BoundedCache(PAIRS_KEPT, self._find_patches)
        self.footprints = BoundedCache(ASSETS_KEPT, self._find_footprint)
        """Footprint class of each asset ("" for none), and the asset's pose in the frame of the class's box."""
        self.bases = BoundedCache(ASSETS_KEPT, self._find_base)
        """Contact polygon of each upright asset; see ``statics``."""
        self.barriers = BoundedCache(BARRIERS_KEPT, self._find_barriers)
        """Barriers around the cavities of an asset at a pose with these joint positions."""

    def verified(self, held: str, target: str, relation: Relation) -> Iterator[CandidatePoses]:
        """Poses verified for this pair of assets, then those verified for the footprint of the held object."""
        key = self._key(held, target, relation)
        for sets in (self._of_pair, self._of_class):
            found = sets[key]
            if found is not None:
                yield found

    def fresh(self, held: str, target: str, relation: Relation, shift: Vec2, tries: int) -> CandidatePoses:
        """Return up to ``tries`` poses by geometry alone, spread over the surfaces; ``shift`` moves the whole pattern."""
        found = self._patches[self._key(held, target, relation)]
        yaws, points = found.yaws, spread_over(found.centers_m, found.rooms_m, shift, tries)

        def exact(number: int) -> Pose:
            x, y, z = points[number].tolist()
            return Pose.from_xyz_yaw(x, y, z, yaws[number % len(yaws)])

        return CandidatePoses(found.middles.repeated_at(points), exact)

    def warm_up_fresh(self, held: str, target: str, relation: Relation) -> None:
        """Prepare fresh poses for a pair in the scene as loaded. Changes no answer."""
        objects = self._scene.by_name
        middles = self._patches[self._key(held, target, relation)].middles
        middles.extents[objects[target].pose_world_asset.quat_xyzw, objects[held].joints]

    def _key(self, held: str, target: str, relation: Relation) -> PlacementKey:
        objects = self._scene.by_name
        return PlacementKey(objects[held].asset_id, objects[target].asset_id, relation)

    def _find_of_pair(self, key: PlacementKey) -> CandidatePoses | None:
        return self._verified(key, key.asset_id, IDENTITY)

    def _find_of_class(self, key: PlacementKey) -> CandidatePoses | None:
        return self._verified(key, *self.footprints[key.asset_id])

    def _verified(self, key: PlacementKey, held: str, pose_held_asset: Pose) -> CandidatePoses | None:
        """Poses of a pair that were verified for ``held`` on the support; the asset's pose in its frame is given."""
        verified = PlacementKey(held, key.support_asset_id, key.relation)
        rows = rows_of(self._cache.placements, verified)  # (n, 7)
        if not len(rows):
            return None
        bounds = bounds_of(self._scene.assets[key.asset_id])
        support = self._scene.assets[key.support_asset_id]
        places = PoseSet.of(bounds, rows, [""] * len(rows), pose_held_asset)
        if not links_with_surfaces(support) <= {""}:
            boxes = places.world_boxes((), {"": IDENTITY}).each()
            links = [link_under(box, support, key.relation) for box in boxes]
            places = PoseSet.of(bounds, rows, links, pose_held_asset)

        def exact(number: int) -> Pose:
            x, y, z, a, b, c, d = rows[number].tolist()
            return Pose((x, y, z), (a, b, c, d)) @ pose_held_asset

        return CandidatePoses(places, exact)

    def _find_patches(self, key: PlacementKey) -> PatchSet:
        bounds = bounds_of(self._scene.assets[key.asset_id])
        found = patches(bounds, self._scene.assets[key.support_asset_id], key.relation)
        middles = [Pose.from_xyz_yaw(*patch.center_m, patch.yaw) for patch in found]
        return PatchSet(
            np.array([patch.center_m for patch in found]).reshape(-1, 3),
            np.array([patch.room_m for patch in found]).reshape(-1, 2),
            tuple(patch.yaw for patch in found),
            PoseSet.of(bounds, pose_rows(middles), [patch.link for patch in found]),
        )

    def _find_barriers(self, key: tuple[str, Pose, tuple[float, ...]]) -> tuple[Barrier, ...]:
        asset_id, pose, fractions = key
        return barriers(self._scene.assets[asset_id], pose, fractions)

    def _find_base(self, asset_id: str) -> Base | None:
        return base_of(self._scene.assets[asset_id])

    def _find_footprint(self, asset_id: str) -> tuple[str, Pose]:
        asset = self._scene.assets[asset_id]
        standing = self._cache.placements.get(PlacementKey(asset_id, LEVEL_FLOOR, Relation.ONTOP))
        footprint = footprint_of(asset, standing[0]) if standing else None
        if not standing or footprint is None:
            return "", IDENTITY
        return footprint.name, pose_box_asset(footprint, asset, standing[0])
