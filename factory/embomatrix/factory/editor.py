"""Adding a task's objects to a base scene: seeded rest poses that are free, in reach and collide with nothing."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.furnish.roles import is_portable
from embomatrix.factory.scenes.check import reach_problems
from embomatrix.factory.scenes.clearance import Clearance
from embomatrix.factory.scenes.floor import ReachableFloor, box_of
from embomatrix.factory.scenes.joints import with_joints
from embomatrix.factory.scenes.solids import Solids, placed_parts
from embomatrix.sim.candidates import candidates
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset, Link, SupportSurface
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.geometry import Aabb, Part, Pose, Shape
from embomatrix.world.scene import SceneObject
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np

    from embomatrix.world.scene import Room, Scene
    from embomatrix.world.state import State

TRIES: Final = 64
_FLOOR_TRIES: Final = 200
_REST_GAP_M: Final = 0.0005
_ON_FLOOR_M: Final = 0.05
_FLAT_M: Final = 0.03


_SUNK_M: Final = 0.008
"""How deep the plate of a floor lies: near enough for things to be on it, too deep for them to touch it (5 mm)."""
_PLATE_M: Final = 0.01


class PlacementReason(StrEnum):
    """Why an object found no place."""

    UNKNOWN_HOST = "unknown_host"
    UNKNOWN_MODEL = "unknown_model"
    NO_SURFACE = "no_surface"
    TOO_LARGE = "too_large"
    NO_FREE_SPOT = "no_free_spot"
    OUT_OF_REACH = "out_of_reach"


class PlacementError(ValueError):
    """An object can't be placed; ``reason`` says which rule stood against it."""

    def __init__(self, reason: PlacementReason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(slots=True)
class _Tally:
    """How many candidate poses there were, and how many of them collided with nothing."""

    seen: int = 0
    free: int = 0


class SceneEditor:
    """Collects changes to a base scene; ``freeze`` makes the new scene. The base scene itself is never changed."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self._scene = scene
        self._rng = rng
        self._objects: dict[str, SceneObject] = {item.name: item for item in scene.objects}
        self._assets: dict[str, Asset] = dict(scene.assets)
        self._rooms = {room.name: room for room in scene.rooms}
        self._solids = Solids.of_scene(scene)
        self._floor = ReachableFloor(scene)
        self._clearance = Clearance(scene)
        self._unreached = {problem.names for problem in reach_problems(scene)}
        self._counts = Counter(self._assets[item.asset_id].category for item in scene.objects)

    @property
    def objects(self) -> Mapping[str, SceneObject]:
        """The objects so far, by name."""
        return self._objects

    def add(
        self, category: str, model: str | None, relation: Relation | None, host: str, *, room: str = ""
    ) -> str:
        """Place a new object and return its name, ``category_N``.

        ``host`` is an object that it goes on, in, under or next to, or a room when ``relation`` is None or INROOM: then it
        stands on that room's floor. Without a model one of the category is drawn, any that fits. Raises PlacementError.
        """
        assets = self._choices(category, model)
        errors: list[PlacementError] = []
        for asset in assets:
            try:
                pose, where = self._find(asset, relation, host)
            except PlacementError as error:
                errors.append(error)
                continue
            return self._insert(asset, pose, room or where, relation, host)
        raise errors[-1]

    def add_pieces(self, whole: str, category: str, model: str, count: int) -> tuple[str, ...]:
        """Add absent objects that come in when ``whole`` is sliced, and return their names. Raises PlacementError."""
        (asset,) = self._choices(category, model)
        origin = self._known(whole)
        names: list[str] = []
        for _ in range(count):
            self._counts[asset.category] += 1
            names.append(f"{asset.category}_{self._counts[asset.category]}")
            self._objects[names[-1]] = SceneObject(
                name=names[-1],
                asset_id=asset.asset_id,
                room=origin.room,
                pose_world_asset=origin.pose_world_asset,
                fixed=False,
                joints=(0.0,) * len(asset.joints),
                absent=True,
            )
        self._assets[asset.asset_id] = asset
        self._objects[whole] = replace(origin, pieces=(*origin.pieces, *names))
        return tuple(names)

    def add_floor(self, room: str) -> str:
        """Make the floor of a room an object that plans and goals can name, and return its name."""
        area = self._rooms[room]
        asset = floor_asset(area)
        x, y = area.center_m
        name = self._insert(asset, Pose((x, y, -_SUNK_M - _PLATE_M / 2)), room, None, "")
        self._objects[name] = replace(self._objects[name], fixed=True)
        return name

    def set_states(self, name: str, states: frozenset[State]) -> None:
        """Give an object these symbolic states. Raises PlacementError for an unknown name."""
        self._objects[name] = replace(self._known(name), states=frozenset(states))

    def set_joints(self, name: str, fractions: Sequence[float]) -> None:
        """Open or shut an object's joints, one share of the travel for each, with all that lies in its drawers.

        Raises PlacementError, ValueError.
        """
        item = self._known(name)
        joints = self._assets[item.asset_id].joints
        if len(fractions) != len(joints) or not all(0.0 <= f <= 1.0 for f in fractions):
            raise ValueError(
                f"{name!r} was given joints {tuple(fractions)}: expected {len(joints)} numbers between 0 and 1"
            )
        self._objects.update(with_joints(self._objects, self._assets, name, fractions))

    def freeze(self, scene_id: str) -> Scene:
        """The scene as it is now, with the assets that it uses."""
        objects = tuple(self._objects.values())
        used = {item.asset_id: self._assets[item.asset_id] for item in objects}
        return replace(self._scene, scene_id=scene_id, objects=objects, assets=used)

    def _known(self, name: str) -> SceneObject:
        if name not in self._objects:
            raise PlacementError(
                PlacementReason.UNKNOWN_HOST,
                f"no object {name!r} in {self._scene.scene_id}: expected one of its {len(self._objects)} objects",
            )
        return self._objects[name]

    def _choices(self, category: str, model: str | None) -> list[Asset]:
        """The model's asset, or those of the category in random order."""
        catalog = Catalog.load()
        try:
            if model is not None:
                return [build_asset(catalog, category, model)]
            models = catalog.models_of(category)
        except CatalogError as error:
            raise PlacementError(PlacementReason.UNKNOWN_MODEL, str(error)) from error
        order = self._rng.permutation(len(models))[:8]
        return [build_asset(catalog, category, models[i].model_id) for i in order]

    def _find(self, asset: Asset, relation: Relation | None, host: str) -> tuple[Pose, str]:
        """A free pose and its room."""
        if relation is None or relation is Relation.INROOM:
            if host not in self._rooms:
                raise PlacementError(
                    PlacementReason.UNKNOWN_HOST,
                    f"no room {host!r} in {self._scene.scene_id}: expected one of {', '.join(self._rooms)}",
                )
            return self._choose(asset, self._on_floor(asset, self._rooms[host]), None, host)
        target = self._known(host)
        if relation is Relation.NEXTTO:
            return self._choose(asset, self._beside(asset, target), None, host)
        poses = [
            target.pose_world_asset @ local
            for local in candidates(asset, self._assets[target.asset_id], relation, self._shift(), TRIES)
        ]
        if not poses:
            carrier = self._assets[target.asset_id]
            reason = PlacementReason.TOO_LARGE if carrier.supports else PlacementReason.NO_SURFACE
            raise PlacementError(
                reason,
                f"{asset.asset_id}, {_metres(asset)}, fits nowhere {relation.value} {host} ({_metres(carrier)}): "
                "try a smaller model or another host",
            )
        order = self._rng.permutation(len(poses))
        return self._choose(asset, iter([poses[i] for i in order]), target, host)

    def _choose(
        self, asset: Asset, poses: Iterator[Pose], target: SceneObject | None, host: str
    ) -> tuple[Pose, str]:
        """The first pose that collides with nothing and is in reach; raises with the rule that failed the most."""
        tally = _Tally()
        for pose in poses:
            tally.seen += 1
            if self._solids.overlaps(placed_parts(asset, pose)):
                continue
            tally.free += 1
            box = Aabb.around(part.aabb(pose) for link in asset.links for part in link.parts)
            room = self._scene.room_at(box.center_m)
            if room and self._in_reach(box, target) and self._leaves_ways(asset, pose, box, room):
                return pose, room
        reason = PlacementReason.OUT_OF_REACH if tally.free else PlacementReason.NO_FREE_SPOT
        raise PlacementError(
            reason,
            f"no place for {asset.asset_id}, {_metres(asset)}, at {host}: of {tally.seen} poses {tally.free} were free, "
            "none of them in the robot's reach without barring its way: try another host",
        )

    def _in_reach(self, box: Aabb, target: SceneObject | None) -> bool:
        if not ROBOT.reach_low_m <= box.center_m[2] <= ROBOT.reach_high_m:
            return False
        front = target.pose_world_asset if target and self._assets[target.asset_id].joints else None
        return len(self._floor.spots(box, front_of=front)) > 0

    def _leaves_ways(self, asset: Asset, pose: Pose, box: Aabb, room: str) -> bool:
        """Whether, with the object on the floor, doorways stay clear and the robot gets to all that it got to before."""
        if box.low_m[2] > _ON_FLOOR_M or box.high_m[2] < _FLAT_M:
            return True
        if self._clearance.bars_a_doorway(box):
            return False
        item = SceneObject("candidate", asset.asset_id, room, pose, fixed=False)
        assets = {**self._assets, asset.asset_id: asset}
        trial = replace(self._scene, objects=(*self._objects.values(), item), assets=assets)
        return {p.names for p in reach_problems(trial)} <= self._unreached

    def _on_floor(self, asset: Asset, room: Room) -> Iterator[Pose]:
        (x0, y0), (x1, y1) = room.low_m, room.high_m
        for _ in range(_FLOOR_TRIES):
            x, y = self._rng.uniform(x0, x1), self._rng.uniform(y0, y1)
            yield self._standing(asset, float(x), float(y))

    def _beside(self, asset: Asset, target: SceneObject) -> Iterator[Pose]:
        """Poses at the height of what the target stands on, a few centimetres from its sides."""
        box = box_of(self._scene, target) if target.name in self._scene.by_name else self._box(target)
        gap = 0.03 + max(asset.size_m[:2]) / 2
        support = self._objects.get(target.host)
        for _ in range(_FLOOR_TRIES):
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
        """Whether a surface of the object lies under the point, at its height."""
        px, py, pz = support.pose_world_asset.inverse().apply((x, y, z))
        return any(
            abs(px - s.center_m[0]) < s.size_m[0] / 2
            and abs(py - s.center_m[1]) < s.size_m[1] / 2
            and abs(pz - s.center_m[2]) < 0.005
            for s in self._assets[support.asset_id].supports
        )

    def _standing(self, asset: Asset, x: float, y: float) -> Pose:
        return Pose.from_xyz_yaw(x, y, asset.size_m[2] / 2 + _REST_GAP_M, self._yaw())

    def _yaw(self) -> float:
        return float(self._rng.integers(4)) * 1.5707963267948966

    def _shift(self) -> tuple[float, float]:
        return (float(self._rng.random()), float(self._rng.random()))

    def _box(self, item: SceneObject) -> Aabb:
        asset = self._assets[item.asset_id]
        return Aabb.around(part.aabb(item.pose_world_asset) for link in asset.links for part in link.parts)

    def _insert(self, asset: Asset, pose: Pose, room: str, relation: Relation | None, host: str) -> str:
        self._counts[asset.category] += 1
        name = f"{asset.category}_{self._counts[asset.category]}"
        rests = relation in (Relation.ONTOP, Relation.INSIDE)
        carrier = host if rests else self._objects[host].host if relation is Relation.NEXTTO else ""
        self._objects[name] = SceneObject(
            name=name,
            asset_id=asset.asset_id,
            room=room,
            pose_world_asset=pose,
            fixed=not is_portable(asset),
            joints=(0.0,) * len(asset.joints),
            host=carrier,
            relation=relation if rests else Relation.ONTOP if carrier else None,
        )
        self._assets[asset.asset_id] = asset
        self._solids.add(name, placed_parts(asset, pose))
        if pose.position_m[2] - asset.size_m[2] / 2 < _ON_FLOOR_M:
            objects = tuple(self._objects.values())
            self._floor = ReachableFloor(replace(self._scene, objects=objects, assets=self._assets))
        return name


def _metres(asset: Asset) -> str:
    return " x ".join(f"{extent:.2f}" for extent in asset.size_m) + " m"


def floor_asset(room: Room) -> Asset:
    """The floor of a room as a fixed thing: a plate just below the ground, and a surface that is the ground itself."""
    size = (*room.size_m, _PLATE_M)
    return Asset(
        asset_id=f"floors-{room.name}",
        category="floors",
        synset="floor.n.01",
        size_m=size,
        mass_kg=100.0,
        links=(Link("base", (Part(Shape.BOX, Pose((0.0, 0.0, 0.0)), size),)),),
        supports=(SupportSurface("floor", (0.0, 0.0, _PLATE_M / 2 + _SUNK_M), room.size_m, 2.0),),
    )
