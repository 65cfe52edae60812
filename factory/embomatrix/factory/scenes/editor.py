"""Editor of a base scene: its objects, free space and the floor that the robot can reach.

The editor checks poses; the layout agents choose them.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import Final

from embomatrix.factory.assets.solids import Solids, placed_parts
from embomatrix.factory.clutter.background import without_covered
from embomatrix.factory.clutter.space import TakenSpace, needed_space
from embomatrix.factory.furnish.roles import is_portable
from embomatrix.factory.scenes.check import reach_problems
from embomatrix.factory.scenes.clearance import Clearance
from embomatrix.factory.scenes.floor import ReachableFloor, SceneBoxes, box_at
from embomatrix.factory.scenes.joints import with_joints
from embomatrix.factory.scenes.view import SceneView
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import FLOOR_CATEGORY, Asset, Link, SupportSurface
from embomatrix.world.geometry import IDENTITY, Aabb, ConvexPart, Pose, Shape
from embomatrix.world.scene import BackgroundObject, Room, Scene, SceneObject
from embomatrix.world.state import Relation, State

_ON_FLOOR_M: Final = 0.05
_FLAT_M: Final = 0.03
_SUNK_M: Final = 0.008
"""Depth of a floor plate: near enough for objects to rest on it, too deep for contact (5 mm)."""
_PLATE_M: Final = 0.01


class LayoutReason(StrEnum):
    """Reason why an object has no place."""

    UNKNOWN_HOST = "unknown_host"
    UNKNOWN_MODEL = "unknown_model"
    NO_HOST = "no_host"
    NO_POSE = "no_pose"
    NO_SURFACE = "no_surface"
    TOO_LARGE = "too_large"
    NO_FREE_SPOT = "no_free_spot"
    OUT_OF_REACH = "out_of_reach"
    BLOCKS_PATH = "blocks_path"
    UNSTABLE = "unstable"
    INACCESSIBLE = "inaccessible"
    RELATION_NOT_HELD = "relation_not_held"


class PlacementError(ValueError):
    """Object that can't be placed. ``reason`` names the violated rule."""

    def __init__(self, reason: LayoutReason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class SceneEditor:
    """Changes to a base scene. ``freeze`` returns the new scene; the base scene is never changed."""

    def __init__(self, scene: Scene) -> None:
        self.base = scene
        self.rooms: Mapping[str, Room] = {room.name: room for room in scene.rooms}
        self.clearance = Clearance(scene)
        self.view = SceneView(scene)
        """View of the base scene."""
        self._objects: dict[str, SceneObject] = {item.name: item for item in scene.objects}
        self._assets: dict[str, Asset] = dict(scene.assets)
        self._background = scene.background
        self._solids = Solids.of_scene(replace(scene, background=()))
        self._kept: set[str] = set()
        self._boxes = SceneBoxes()
        self.floor = ReachableFloor(scene, self._boxes)
        """Floor that the robot can reach in the current scene."""
        self._unreached = {problem.names for problem in reach_problems(scene, self._boxes)}
        self.unserved = frozenset(name for names in self._unreached for name in names)
        """Objects of the base scene that the robot can't reach initially."""
        self.given_up: set[str] = set()
        """Objects of the base scene that new objects may make unreachable."""
        self._counts = Counter(self._assets[item.asset_id].category for item in scene.objects)

    @property
    def objects(self) -> Mapping[str, SceneObject]:
        """Current objects by name, in scene order."""
        return self._objects

    @property
    def background(self) -> tuple[BackgroundObject, ...]:
        """Background objects that have given way to no object and whose host is still there."""
        return tuple(item for item in self._background if not item.host or item.host in self._objects)

    def known(self, name: str) -> SceneObject:
        """Return an object. Raise PlacementError for an unknown name."""
        if name not in self._objects:
            raise PlacementError(
                LayoutReason.UNKNOWN_HOST,
                f"no object {name!r} in {self.base.scene_id}: expected one of its {len(self._objects)} objects",
            )
        return self._objects[name]

    def asset_of(self, name: str) -> Asset:
        """Return an object's asset. Raise PlacementError for an unknown name."""
        return self._assets[self.known(name).asset_id]

    @property
    def imported(self) -> Mapping[str, Asset]:
        """Imported models that the base scene uses, by asset id. New objects of these ids must use them, too."""
        return {key: asset for key, asset in self.base.assets.items() if asset.credit is not None}

    def box_of(self, name: str) -> Aabb:
        """Return an object's box in the world with closed joints. Raise PlacementError for an unknown name."""
        return self._boxes.whole(self.asset_of(name), self.known(name).pose_world_asset)

    def keep(self, names: Iterable[str]) -> None:
        """Protect objects of the base scene that the task is about."""
        self._kept.update(names)

    def is_spare(self, name: str) -> bool:
        """True if an object of the base scene may be removed with all objects on it."""
        carried = {item.name for item in self._objects.values() if item.host == name}
        return name in self.base.by_name and not self._kept & {name, *carried}

    def is_free(self, asset: Asset, pose: Pose) -> bool:
        """True if an asset overlaps nothing at a pose."""
        return self._solids.is_clear(placed_parts(asset, pose))

    def objection(self, asset: Asset, pose: Pose, target: str = "") -> LayoutReason | None:
        """Return the rule that an asset violates at a pose: collision, reach, or a blocked path. None if it is valid.

        ``target`` is its host. Furniture with doors is served from its front.
        """
        if not self.is_free(asset, pose):
            return LayoutReason.NO_FREE_SPOT
        box = box_at(asset, pose)
        room = self.base.room_at(box.center_m)
        if not room:
            return LayoutReason.NO_FREE_SPOT
        if not self._in_reach(box, target):
            return LayoutReason.OUT_OF_REACH
        return None if self._keeps_paths_clear(asset, pose, box, room) else LayoutReason.BLOCKS_PATH

    def insert(self, asset: Asset, pose: Pose, relation: Relation | None, host: str, room: str = "") -> str:
        """Add an object at a pose without checks, and return its name, ``category_N``. Background gives way.

        ``host`` supports it in ``relation``; empty means the floor. Without a room, the object's position decides.
        """
        name = self._new_name(asset)
        box = box_at(asset, pose)
        self._objects[name] = SceneObject(
            name=name,
            asset_id=asset.asset_id,
            room=room or self.base.room_at(box.center_m),
            pose_world_asset=pose,
            fixed=not is_portable(asset),
            joints=(0.0,) * len(asset.joints),
            host=host,
            relation=relation if host else None,
        )
        self._assets[asset.asset_id] = asset
        self._solids.add(name, placed_parts(asset, pose))
        self._clear_around(name)
        if box.low_m[2] < _ON_FLOOR_M:
            self._update_floor()
        return name

    def fasten(self, name: str) -> None:
        """Make an object fixed, such as a picture on a wall. Raise PlacementError for an unknown name."""
        self._objects[name] = replace(self.known(name), fixed=True)

    def loosen(self, name: str) -> None:
        """Make an object movable. Raise PlacementError for an unknown name."""
        self._objects[name] = replace(self.known(name), fixed=False)

    def remove(self, name: str) -> tuple[str, ...]:
        """Remove an object with all objects on or in it, and return their names. Raise PlacementError for an unknown name."""
        self.known(name)
        gone = {name: None}
        for item in self._objects.values():  # hosts precede the objects on them
            if item.host in gone:
                gone[item.name] = None
        for each in gone:
            del self._objects[each]
        self._solids.remove(gone)
        self._update_floor()
        return tuple(gone)

    def clear(self, name: str) -> None:
        """Remove the background objects on an object. Raise PlacementError for an unknown name."""
        host = self.known(name).name
        self._background = tuple(item for item in self._background if item.host != host)

    def move(self, poses: Mapping[str, Pose]) -> None:
        """Set the poses of objects. Background gives way. Raise PlacementError for an unknown name."""
        for name, pose in poses.items():
            self._objects[name] = replace(self.known(name), pose_world_asset=pose)
            self._clear_around(name)
        self._solids.remove(poses)
        for name, pose in poses.items():
            self._solids.add(name, placed_parts(self.asset_of(name), pose))
        if poses:
            self._update_floor()

    def add_pieces(self, whole: str, asset: Asset, count: int) -> tuple[str, ...]:
        """Add absent objects that appear when ``whole`` is sliced, and return their names. Raise PlacementError."""
        origin = self.known(whole)
        names: list[str] = []
        for _ in range(count):
            names.append(self._new_name(asset))
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

    def set_states(self, name: str, states: frozenset[State]) -> None:
        """Set an object's symbolic states. Raise PlacementError for an unknown name."""
        self._objects[name] = replace(self.known(name), states=frozenset(states))

    def set_joints(self, name: str, fractions: Sequence[float]) -> None:
        """Set the joints of an object as fractions of their travel. Objects in its drawers move with them.

        Raise PlacementError or ValueError.
        """
        item = self.known(name)
        joints = self._assets[item.asset_id].joints
        if len(fractions) != len(joints) or not all(0.0 <= f <= 1.0 for f in fractions):
            raise ValueError(
                f"{name!r} has joint fractions {tuple(fractions)}: expected {len(joints)} numbers between 0 and 1"
            )
        self._objects.update(with_joints(self._objects, self._assets, name, fractions))

    def freeze(self, scene_id: str) -> Scene:
        """Return the current scene with the assets that it uses."""
        scene = self._as_scene()
        used = {item.asset_id for item in scene.objects} | {item.asset_id for item in scene.background}
        assets = {key: asset for key, asset in self._assets.items() if key in used}
        return replace(scene, scene_id=scene_id, assets=assets)

    def _new_name(self, asset: Asset) -> str:
        self._counts[asset.category] += 1
        return f"{asset.category}_{self._counts[asset.category]}"

    def _as_scene(self) -> Scene:
        return replace(
            self.base,
            objects=tuple(self._objects.values()),
            background=self.background,
            assets=self._assets,
        )

    def _update_floor(self) -> None:
        self.floor = ReachableFloor(self._as_scene(), self._boxes)

    def _clear_around(self, name: str) -> None:
        """Remove the background where an object needs space, and what stands on removed background."""
        item = self._objects[name]
        needed = TakenSpace.of(needed_space(self._assets[item.asset_id], item))
        self._background = without_covered(replace(self.base, background=self._background), needed)

    def _in_reach(self, box: Aabb, target: str) -> bool:
        if not ROBOT.reach_low_m <= box.center_m[2] <= ROBOT.reach_high_m:
            return False
        front = self.known(target).pose_world_asset if target and self.asset_of(target).joints else None
        return len(self.floor.spots(box, front_of=front)) > 0

    def _keeps_paths_clear(self, asset: Asset, pose: Pose, box: Aabb, room: str) -> bool:
        """True if doorways stay clear and everything reachable before stays reachable with this object on the floor."""
        if box.low_m[2] > _ON_FLOOR_M or box.high_m[2] < _FLAT_M:
            return True
        if self.clearance.bars_a_doorway(box):
            return False
        item = SceneObject("candidate", asset.asset_id, room, pose, fixed=False)
        assets = {**self._assets, asset.asset_id: asset}
        trial = replace(self.base, objects=(*self._objects.values(), item), background=(), assets=assets)
        known = self._unreached | {(name,) for name in self.given_up}
        return {problem.names for problem in reach_problems(trial, self._boxes)} <= known


def add_floor(editor: SceneEditor, room: str) -> str:
    """Make the floor of a room an object that plans and goals can name, and return its name."""
    area = editor.rooms[room]
    x, y = area.center_m
    name = editor.insert(floor_asset(area), Pose((x, y, -_SUNK_M - _PLATE_M / 2)), None, "", room)
    editor.fasten(name)
    return name


def floor_asset(room: Room) -> Asset:
    """Return the floor of a room as a fixed asset: a plate below the ground with a support surface at ground level."""
    size = (*room.size_m, _PLATE_M)
    return Asset(
        asset_id=f"floors-{room.name}",
        category=FLOOR_CATEGORY,
        synset="floor.n.01",
        size_m=size,
        mass_kg=100.0,
        links=(Link("base", (ConvexPart(Shape.BOX, IDENTITY, size),)),),
        supports=(SupportSurface("floor", (0.0, 0.0, _PLATE_M / 2 + _SUNK_M), room.size_m, 2.0),),
    )
