"""Object-level Sampling Agent: continuous poses on, in, under and beside objects.

Each pose is free, reachable and blocks no path.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.scenes.editor import LayoutReason, PlacementError, SceneEditor
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.candidates import candidates, patches, stands_in
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.geometry import Pose
from embomatrix.world.scene import Room, SceneObject
from embomatrix.world.state import Relation

TRIES: Final = 64
PACKING_GAP_M: Final = 0.004
"""Gap in metres between objects packed side by side."""
FLOOR_TRIES: Final = 200
EDGE_POSES: Final = 24
EDGE_SHARE: Final = 0.15
"""Number of poses tried under a carrier's edges, and the share of an object's width that lies behind the edge."""
MAX_BLOCKING: Final = 16
"""Number of poses that block the robot's path after which a search ends. Each costs a check of all paths."""
MODELS: Final = 8
"""Maximum number of a category's models tried if no model is given."""
LIFT_M: Final = 0.0005
"""Initial gap between an object and its support, so that no object starts in contact."""


class ObjectSampler:
    """Sampler of poses for single objects in a scene editor. The random generator's state decides every pose."""

    def __init__(self, editor: SceneEditor, rng: np.random.Generator) -> None:
        self._editor = editor
        self._rng = rng

    def add(self, category: str, model: str | None, relation: Relation | None, host: str) -> str:
        """Place a new object and return its name, ``category_N``.

        ``host`` is an object, or a room if ``relation`` is None or INROOM; then the object stands on the room's
        floor. Without a model, models of the category are tried in random order. Raise PlacementError.
        """
        errors: list[PlacementError] = []
        for generated in assets_of(category, model, self._rng):
            asset = self._editor.imported.get(generated.asset_id, generated)
            try:
                pose = self.find(asset, relation, host)
            except PlacementError as error:
                errors.append(error)
                continue
            return self._editor.insert(asset, pose, *self.rests(relation, host))
        raise errors[-1]

    def find(self, asset: Asset, relation: Relation | None, host: str) -> Pose:
        """Return a valid pose. Raise PlacementError with the rule that rejected most poses."""
        target = host if relation in (Relation.ONTOP, Relation.INSIDE, Relation.UNDER) else ""
        return self.first_free(asset, self.poses(asset, relation, host), target)

    def pack(self, asset: Asset, host: str) -> Pose:
        """Return a pose in a corner of a container, or in a corner between the objects in it. Raise PlacementError.

        If no corner fits, return any valid pose in the container.
        """
        target = self._editor.known(host)
        for local in self._corners(asset, target):
            pose = target.pose_world_asset @ local
            if self._editor.objection(asset, pose, host) is None:
                return pose
        return self.find(asset, Relation.INSIDE, host)

    def _corners(self, asset: Asset, target: SceneObject) -> Iterator[Pose]:
        """Yield corner poses in the container's frame, row by row, at its walls and at the objects in it."""
        editor, bounds = self._editor, bounds_of(asset)
        carrier = editor.asset_of(target.name)
        inverse = target.pose_world_asset.inverse()
        lying = [
            bounds_of(editor.asset_of(name)).box(inverse @ item.pose_world_asset)
            for name, item in editor.objects.items()
            if item.host == target.name
        ]
        for patch in patches(bounds, carrier, Relation.INSIDE):
            box = bounds.box(Pose.from_xyz_yaw(0.0, 0.0, 0.0, patch.yaw))
            lines = [
                sorted(
                    place
                    for place in (
                        middle - room,
                        *(other.high_m[axis] + PACKING_GAP_M - box.low_m[axis] for other in lying),
                    )
                    if abs(place - middle) <= room + 1e-9
                )
                for axis, (middle, room) in enumerate(zip(patch.center_m[:2], patch.room_m, strict=True))
            ]
            for x, y in itertools.product(*lines):
                pose = Pose.from_xyz_yaw(x, y, patch.center_m[2], patch.yaw)
                if stands_in(asset, pose, carrier, Relation.INSIDE):
                    yield pose

    def poses(self, asset: Asset, relation: Relation | None, host: str) -> Iterator[Pose]:
        """Yield unchecked poses in the relation to a host, in random order. Raise PlacementError if there is none."""
        editor = self._editor
        if relation is None or relation is Relation.INROOM:
            if host not in editor.rooms:
                raise PlacementError(
                    LayoutReason.UNKNOWN_HOST,
                    f"no room {host!r} in {editor.base.scene_id}: expected one of {', '.join(editor.rooms)}",
                )
            yield from self._on_floor(asset, editor.rooms[host])
            return
        target = editor.known(host)
        if relation is Relation.NEXTTO:
            yield from self._beside(asset, target)
            return
        carrier = editor.asset_of(host)
        shift = (float(self._rng.random()), float(self._rng.random()))
        local = list(candidates(asset, carrier, relation, shift, TRIES))
        if relation is Relation.UNDER:
            local += self._under_edges(asset, carrier)
        found = [target.pose_world_asset @ pose for pose in local]
        if not found:
            reason = LayoutReason.TOO_LARGE if carrier.supports else LayoutReason.NO_SURFACE
            raise PlacementError(
                reason,
                f"{asset.asset_id}, {_metres(asset)}, fits nowhere {relation.value} {host} ({_metres(carrier)}): "
                "try a smaller model or another host",
            )
        for index in self._rng.permutation(len(found)):
            yield found[index]

    def rests(self, relation: Relation | None, host: str) -> tuple[Relation | None, str]:
        """Return the relation and host that support an object placed at this host. (None, "") means the floor."""
        if relation in (Relation.ONTOP, Relation.INSIDE):
            return relation, host
        if relation is Relation.NEXTTO:
            carrier = self._editor.known(host).host
            return (Relation.ONTOP, carrier) if carrier else (None, "")
        return None, ""

    def first_free(self, asset: Asset, poses: Iterable[Pose], target: str) -> Pose:
        """Return the first valid pose. Raise PlacementError."""
        objections: Counter[LayoutReason] = Counter()
        for pose in poses:
            objection = self._editor.objection(asset, pose, target)
            if objection is None:
                return pose
            objections[objection] += 1
            if objections[LayoutReason.BLOCKS_PATH] == MAX_BLOCKING:
                break
        raise _no_pose_error(objections, asset, target or "the floor")

    def _under_edges(self, asset: Asset, carrier: Asset) -> Iterator[Pose]:
        """Yield poses under a carrier's edges with a good third of the object in the open, such as shoes under a bed."""
        x, y, z = carrier.size_m
        for _ in range(EDGE_POSES):
            side, along = int(self._rng.integers(4)), float(self._rng.uniform(-0.4, 0.4))
            turned = float(self._rng.integers(2)) * math.pi / 2
            depth = asset.size_m[(side >= 2) != (turned > 0)] * EDGE_SHARE
            px = (x / 2 - depth) * (1, -1)[side] if side < 2 else along * x
            py = (y / 2 - depth) * (1, -1)[side - 2] if side >= 2 else along * y
            yield Pose.from_xyz_yaw(px, py, (asset.size_m[2] - z) / 2 + LIFT_M, turned)

    def _on_floor(self, asset: Asset, room: Room) -> Iterator[Pose]:
        (x0, y0), (x1, y1) = room.low_m, room.high_m
        for _ in range(FLOOR_TRIES):
            x, y = self._rng.uniform(x0, x1), self._rng.uniform(y0, y1)
            yield self._standing(asset, float(x), float(y))

    def _beside(self, asset: Asset, target: SceneObject) -> Iterator[Pose]:
        """Yield poses a few centimetres from the target's sides, at the height of the target's support."""
        box = self._editor.box_of(target.name)
        gap = 0.03 + max(asset.size_m[:2]) / 2
        support = self._editor.objects.get(target.host)
        for _ in range(FLOOR_TRIES):
            along = float(self._rng.uniform(-0.5, 0.5))
            side = int(self._rng.integers(4))
            cx, cy, _ = box.center_m
            sx, sy, _ = box.size_m
            x = cx + (sx / 2 + gap) * (1, -1, 0, 0)[side] + along * sx * (side >= 2)
            y = cy + (sy / 2 + gap) * (0, 0, 1, -1)[side] + along * sy * (side < 2)
            if support is None:
                yield self._standing(asset, x, y)
            elif self._carries(support, x, y, box.low_m[2]):
                yield Pose.from_xyz_yaw(x, y, box.low_m[2] + asset.size_m[2] / 2, self._yaw())

    def _carries(self, support: SceneObject, x: float, y: float, z: float) -> bool:
        """True if a surface of the support lies under the point, at its height."""
        px, py, pz = support.pose_world_asset.inverse().apply((x, y, z))
        return any(
            abs(px - s.center_m[0]) < s.size_m[0] / 2
            and abs(py - s.center_m[1]) < s.size_m[1] / 2
            and abs(pz - s.center_m[2]) < 0.005
            for s in self._editor.asset_of(support.name).supports
        )

    def _standing(self, asset: Asset, x: float, y: float) -> Pose:
        return Pose.from_xyz_yaw(x, y, asset.size_m[2] / 2 + LIFT_M, self._yaw())

    def _yaw(self) -> float:
        return float(self._rng.integers(4)) * math.pi / 2


def assets_of(category: str, model: str | None, rng: np.random.Generator) -> list[Asset]:
    """Return the model's asset, or assets of the category in random order. Raise PlacementError for unknown names."""
    catalog = Catalog.load()
    try:
        if model is not None:
            return [build_asset(catalog, category, model)]
        models = catalog.models_of(category)
    except CatalogError as error:
        raise PlacementError(LayoutReason.UNKNOWN_MODEL, str(error)) from error
    return [build_asset(catalog, category, models[i].model_id) for i in rng.permutation(len(models))[:MODELS]]


def _no_pose_error(objections: Counter[LayoutReason], asset: Asset, host: str) -> PlacementError:
    reached = objections[LayoutReason.BLOCKS_PATH]
    free = objections.total() - objections[LayoutReason.NO_FREE_SPOT]
    after_collision = (LayoutReason.BLOCKS_PATH, LayoutReason.OUT_OF_REACH)
    reason = next((each for each in after_collision if objections[each]), LayoutReason.NO_FREE_SPOT)
    return PlacementError(
        reason,
        f"no place for {asset.asset_id}, {_metres(asset)}, at {host}: of {objections.total()} poses {free} were free, "
        f"{reached} of them reachable, none without blocking the robot's path: try another host",
    )


def _metres(asset: Asset) -> str:
    return " x ".join(f"{extent:.2f}" for extent in asset.size_m) + " m"
