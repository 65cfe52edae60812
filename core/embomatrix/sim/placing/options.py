"""Candidate poses of one object on, in or under another: verified poses and fresh ones, independent of the world's state."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Final

import numpy as np

from embomatrix.sim.geometry.batch_poses import LinkBoxes, PoseBoxes, PoseSet
from embomatrix.sim.geometry.bounds import AssetBounds, bounds_of
from embomatrix.sim.geometry.candidates import PLACE_RELATIONS, Patch, patches, proposed_places
from embomatrix.sim.geometry.footprints import LEVEL_FLOOR, footprint_of, pose_box_asset
from embomatrix.sim.geometry.statics import Base, base_of
from embomatrix.sim.geometry.surfaces import link_under, links_with_surfaces
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, Aabb, FloatArray, Pose, Vec2
from embomatrix.world.placements import pose_rows, rows_of
from embomatrix.world.poses import PlacementKey, PoseCache
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation


class CandidatePoses:
    """Poses of one asset in the frames of a support's links. ``local`` returns a pose by its number."""

    def __init__(
        self,
        local: Callable[[int], Pose],
        links: Sequence[str],
        boxes: LinkBoxes,
        places: Callable[[], PoseSet],
    ) -> None:
        """``boxes`` are those of the asset with its joints shut. ``places`` builds the poses as arrays, for other joints."""
        self._local = local
        self._links = links
        self._boxes = boxes
        self._places = places

    def __len__(self) -> int:
        return len(self._links)

    def pose(self, number: int, frames: Mapping[str, Pose]) -> Pose:
        """Pose in the world. Raises KeyError if its link has no frame."""
        return frames[self._links[number]] @ self._local(number)

    def link_pose(self, number: int) -> tuple[str, Pose]:
        """Link that carries a pose, and the pose in that link's frame."""
        return self._links[number], self._local(number)

    def world_boxes(
        self, bounds: AssetBounds, fractions: Sequence[float], frames: Mapping[str, Pose]
    ) -> PoseBoxes:
        """World boxes at all the poses, of the asset with these bounds; at infinity on links without a frame.

        Furniture stands square to the world: there a box in its frame is a world box after quarter turns.
        """
        square = None if any(fractions) else self._boxes.world_boxes(frames)
        return square if square is not None else self._places().world_boxes(bounds, fractions, frames)


@dataclass(frozen=True, slots=True)
class SurfacePattern:
    """Fit of one asset on another by geometry alone; ``middles`` and ``boxes`` hold one pose per patch."""

    patches: tuple[Patch, ...]
    middles: PoseSet
    boxes: LinkBoxes


class PlacementOptions:
    """Candidate poses from a pose cache and from the surfaces of a scene's assets."""

    def __init__(self, scene: Scene, cache: PoseCache) -> None:
        self._scene = scene
        self._cache = cache
        self._exact: dict[PlacementKey, CandidatePoses] = {}
        self._by_class: dict[PlacementKey, CandidatePoses] = {}
        self._footprints: dict[str, tuple[str, Pose]] = {}
        self._bases: dict[str, Base | None] = {}
        self._patterns: dict[PlacementKey, SurfacePattern] = {}

    def warm_up(self, tables: Iterable[Sequence[str]]) -> Iterator[None]:
        """Look up the verified poses for the objects and supports of each table, one pair per step. Changes no answer."""
        scene = self._scene
        for table in tables:
            movable = [name for name in table if not scene.by_name[name].fixed]
            hosts = [name for name in table if links_with_surfaces(scene.asset_of(name))]
            for held, target in itertools.product(movable, hosts):
                for relation in PLACE_RELATIONS:
                    for _ in self.verified(held, target, relation):
                        pass
                yield

    def verified(self, held: str, target: str, relation: Relation) -> Iterator[CandidatePoses]:
        """Poses verified for this pair of assets, then those verified for the footprint of the held object."""
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        key = PlacementKey(one.asset_id, other.asset_id, relation)
        if key not in self._exact:
            self._exact[key] = _verified_candidates(
                rows_of(self._cache.placements, key), IDENTITY, one, other, relation
            )
        yield self._exact[key]
        if key not in self._by_class:
            name, pose_box_held = self.footprint(one)
            boxes = rows_of(self._cache.placements, PlacementKey(name, other.asset_id, relation))
            self._by_class[key] = _verified_candidates(boxes, pose_box_held, one, other, relation)
        yield self._by_class[key]

    def fresh(self, held: str, target: str, relation: Relation, shift: Vec2, tries: int) -> CandidatePoses:
        """Return up to ``tries`` poses by geometry alone, spread over the surfaces; ``shift`` moves the whole pattern."""
        one, other = self._scene.asset_of(held), self._scene.asset_of(target)
        key = PlacementKey(one.asset_id, other.asset_id, relation)
        pattern = self._patterns.get(key)
        if pattern is None:
            found = patches(bounds_of(one), other, relation)
            middles = [Pose.from_xyz_yaw(*patch.center_m, patch.yaw) for patch in found]
            places = PoseSet.of(pose_rows(middles), [patch.link for patch in found])
            pattern = self._patterns[key] = SurfacePattern(found, places, places.boxes(bounds_of(one)))
        return _spread(pattern, shift, tries)

    def base(self, asset: Asset) -> Base | None:
        """Contact polygon of the upright asset; see ``statics``."""
        if asset.asset_id not in self._bases:
            self._bases[asset.asset_id] = base_of(asset)
        return self._bases[asset.asset_id]

    def footprint(self, asset: Asset) -> tuple[str, Pose]:
        """Footprint class of an asset ("" for none), and the asset's pose in the frame of the class's box."""
        known = self._footprints.get(asset.asset_id)
        if known is None:
            key = PlacementKey(asset.asset_id, LEVEL_FLOOR.asset_id, Relation.ONTOP)
            standing = self._cache.placements.get(key)
            footprint = footprint_of(asset, standing[0]) if standing else None
            known = ("", IDENTITY)
            if standing and footprint is not None:
                known = (footprint.name, pose_box_asset(footprint, asset, standing[0]))
            self._footprints[asset.asset_id] = known
        return known


_NO_PLACES: Final = PoseSet.of(pose_rows(()), ())
NO_CANDIDATES: Final = CandidatePoses(
    lambda number: IDENTITY, (), LinkBoxes(np.zeros((0, 6)), (), _NO_PLACES.link_of), lambda: _NO_PLACES
)


def _verified_candidates(
    rows: FloatArray, then: Pose, held: Asset, support: Asset, relation: Relation
) -> CandidatePoses:
    """Candidates at poses in the frame of a support with its joints shut.

    ``rows``, shape (n, 7), are positions and quaternions; ``then`` is the object's pose in each of their frames.
    """
    if not len(rows):
        return NO_CANDIDATES
    links = [""] * len(rows)
    places = PoseSet.of(rows, links, then)
    boxes = places.boxes(bounds_of(held))
    if not links_with_surfaces(support) <= {""}:
        links = [
            link_under(Aabb((a, b, c), (d, e, f)), support, relation)
            for a, b, c, d, e, f in boxes.corners_m.tolist()
        ]
        places = PoseSet.of(rows, links, then)
        boxes = LinkBoxes(boxes.corners_m, places.links, places.link_of)

    def local(number: int) -> Pose:
        x, y, z, a, b, c, d = rows[number].tolist()
        return Pose((x, y, z), (a, b, c, d)) @ then

    # Only the boxes are kept. The arrays are rebuilt for the rare support that is tilted or object that is placed half open.
    return CandidatePoses(local, links, boxes, lambda: PoseSet.of(rows, links, then))


def _spread(pattern: SurfacePattern, shift: Vec2, tries: int) -> CandidatePoses:
    """Candidates at ``tries`` poses, the patches taken in turn."""
    found, middles = pattern.patches, pattern.middles
    points = proposed_places(found, shift, tries)
    links = [patch.link for patch in islice(cycle(found), len(points))]
    rows = np.arange(len(points)) % max(len(found), 1)
    boxes = pattern.boxes.moved(rows, points - middles.positions_m[rows])

    def local(number: int) -> Pose:
        x, y, z = points[number].tolist()
        return Pose.from_xyz_yaw(x, y, z, found[number % len(found)].yaw)

    return CandidatePoses(local, links, boxes, lambda: middles.repeated_at(points))
