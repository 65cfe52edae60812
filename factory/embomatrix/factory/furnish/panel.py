"""A panel of figures on how a scene is furnished: what found a place, what stands at walls, tables and in doorways."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.furnish.roles import FurnitureRole, role_of
from embomatrix.factory.furnish.space import LOW_M, RoomSpace
from embomatrix.factory.scenes.floor import box_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.world.catalog import SceneInventory
    from embomatrix.world.geometry import Aabb
    from embomatrix.world.scene import Room, Scene, SceneObject

WALL_M: Final = 0.15
"""Closer than this to the room's edge is at the wall, as in the counts of iTHOR's rooms."""
SEAT_M: Final = 0.35
"""A chair whose front is this close to a table is at it."""
_WALL_NAMES: Final = (
    "bed bottom_cabinet bottom_cabinet_no_top fridge stove oven dishwasher washer clothes_dryer furniture_sink "
    "pedestal_sink toilet urinal bookcase wardrobe console_table nightstand locker hospital_bed bathtub shower_stall"
)
WALL_TYPES: Final = frozenset(_WALL_NAMES.split())
SEATS: Final = frozenset(("straight_chair", "swivel_chair", "taboret", "music_stool"))
_TABLES: Final = frozenset((FurnitureRole.TABLE, FurnitureRole.LOW_TABLE))
_TABLE_LIKE: Final = frozenset(
    ("bar", "cubicle", "commercial_kitchen_table", "reception_desk", "checkout_counter")
)


@dataclass(frozen=True, slots=True)
class FurnishPanel:
    """Figures of one scene. Shares are in [0, 1]; a share of nothing is 1."""

    scene_id: str
    items: int
    placed: int
    at_wall: float
    """Share of wall types whose back is at an edge of their room."""
    at_table: float
    """Share of chairs that stand before a table and look at it."""
    in_doorways: int
    """Things on the floor before a doorway, in the zone that stays free."""
    free_floor: float
    """Share of the floor where the robot's base can stand, of what it has in the empty rooms."""

    @property
    def placed_share(self) -> float:
        return self.placed / self.items if self.items else 1.0


def panel_of(scene: Scene, inventory: SceneInventory) -> FurnishPanel:
    """Measure a scene that was built from this inventory."""
    boxes = {item.name: box_of(scene, item) for item in scene.objects}
    rooms = {room.name: room for room in scene.rooms}
    standing = [o for o in scene.objects if o.room in rooms and not o.host]
    walled = [o for o in standing if scene.assets[o.asset_id].category in WALL_TYPES]
    seats = [o for o in standing if scene.assets[o.asset_id].category in SEATS]
    tables = [boxes[o.name] for o in standing if _is_table(scene, o)]
    return FurnishPanel(
        scene_id=scene.scene_id,
        items=sum(count for room in inventory.rooms for _, _, count in room.items),
        placed=len(scene.objects),
        at_wall=_share([_backed(o, boxes[o.name], rooms[o.room]) for o in walled]),
        at_table=_share([_seated(scene, o, tables) for o in seats]),
        in_doorways=sum(1 for _ in _in_doorways(scene, standing)),
        free_floor=_free_floor(scene),
    )


def _share(hits: Sequence[bool]) -> float:
    return sum(hits) / len(hits) if hits else 1.0


def _is_table(scene: Scene, item: SceneObject) -> bool:
    asset = scene.assets[item.asset_id]
    return asset.category in _TABLE_LIKE or role_of(asset.category, asset.size_m, asset.mass_kg) in _TABLES


def _backed(item: SceneObject, box: Aabb, room: Room) -> bool:
    """Whether the side away from the front is within WALL_M of the room's edge."""
    yaw = item.pose_world_asset.yaw
    ax, ay = round(math.cos(yaw)), round(math.sin(yaw))
    gap = (
        (box.low_m[0] - room.low_m[0] if ax > 0 else room.high_m[0] - box.high_m[0])
        if ax
        else (box.low_m[1] - room.low_m[1] if ay > 0 else room.high_m[1] - box.high_m[1])
    )
    return gap <= WALL_M


def _seated(scene: Scene, item: SceneObject, tables: Sequence[Aabb]) -> bool:
    """Whether a point a little before the chair's front edge, or over its own front half, lies on a table."""
    depth = scene.assets[item.asset_id].size_m[0]
    pose = item.pose_world_asset
    for ahead in (0.0, SEAT_M / 2, SEAT_M):
        x, y, _ = pose.apply((depth / 2 + ahead, 0.0, 0.0))
        if any(t.low_m[0] <= x <= t.high_m[0] and t.low_m[1] <= y <= t.high_m[1] for t in tables):
            return True
    return False


def _in_doorways(scene: Scene, standing: Sequence[SceneObject]) -> Iterator[SceneObject]:
    for room in scene.rooms:
        space = RoomSpace(room, scene.doorways)
        for item in standing:
            parts = [p.aabb(item.pose_world_asset) for p in scene.assets[item.asset_id].links[0].parts]
            rows = np.array([(*box.low_m, *box.high_m) for box in parts if box.high_m[2] > LOW_M])
            if item.room == room.name and len(rows) and space.blocks_zone(rows).any():
                yield item


def _free_floor(scene: Scene) -> float:
    free = total = 0.0
    for room in scene.rooms:
        bare, space = RoomSpace(room, scene.doorways), RoomSpace(room, scene.doorways)
        space.occupy(
            [
                (*box.low_m, *box.high_m)
                for o in scene.objects
                if o.room == room.name
                for box in (part.aabb(o.pose_world_asset) for part in scene.assets[o.asset_id].links[0].parts)
            ]
        )
        free += len(space.free_cells())
        total += len(bare.free_cells())
    return free / total if total else 1.0
