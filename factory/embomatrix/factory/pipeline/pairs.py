"""Poses next to one another: no skill aims at ``nextto``, so a plan brings it about where a cache holds no other poses.

What a thing is to stand next to either stays where it is, or is carried too. Then it has one pose in or on what both go to,
and the other's are all beside that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.factory.scenes.solids import Solids, placed_parts
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.world.poses import PlacementKey
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from embomatrix.factory.scenes.view import SceneView
    from embomatrix.sim.placing.pose_cache import PlacementLibrary
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Aabb, Pose
    from embomatrix.world.poses import StandPose

    Poses = dict[PlacementKey, tuple[Pose, ...]]


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
