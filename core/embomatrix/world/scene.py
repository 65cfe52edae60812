"""Scenes: rooms and placed objects, frozen."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np

from embomatrix.world.asset import Asset
from embomatrix.world.geometry import Aabb, ConvexPart, Pose, Shape, Vec2, Vec3
from embomatrix.world.state import Relation, State, SubstanceFact

ROOM_HEIGHT_M: Final = 2.4
"""Height of a room whose record gives none."""


@dataclass(frozen=True, slots=True)
class Room:
    """Axis-aligned rectangle of floor. ``low_m`` and ``high_m`` are its corners in the world's xy plane.

    ``height_m`` is the height of its ceiling above the floor; nothing stands for the ceiling itself.
    """

    name: str
    type: str
    low_m: Vec2
    high_m: Vec2
    height_m: float = ROOM_HEIGHT_M

    @property
    def size_m(self) -> Vec2:
        return (self.high_m[0] - self.low_m[0], self.high_m[1] - self.low_m[1])

    @property
    def center_m(self) -> Vec2:
        return ((self.high_m[0] + self.low_m[0]) / 2, (self.high_m[1] + self.low_m[1]) / 2)

    def contains(self, x: float, y: float, margin_m: float = 0.0) -> bool:
        return (
            self.low_m[0] - margin_m <= x <= self.high_m[0] + margin_m
            and self.low_m[1] - margin_m <= y <= self.high_m[1] + margin_m
        )


@dataclass(frozen=True, slots=True)
class Doorway:
    """Opening in a wall between two rooms; ``rooms[1]`` is empty for a door to the outside.

    ``center_m`` lies on the floor; ``along`` is "x" or "y", the axis of the wall.
    """

    rooms: tuple[str, str]
    center_m: Vec2
    width_m: float
    height_m: float
    along: str
    model: str = ""


@dataclass(frozen=True, slots=True)
class Window:
    """Opening in a wall, closed by a pane; ``rooms[1]`` is empty for a view to the outside.

    ``center_m`` lies on the floor below the window; the opening reaches from ``sill_m`` to ``head_m`` above the floor;
    ``along`` is "x" or "y", the axis of the wall.
    """

    rooms: tuple[str, str]
    center_m: Vec2
    width_m: float
    sill_m: float
    head_m: float
    along: str
    model: str = ""


@dataclass(frozen=True, slots=True)
class SceneObject:
    """Placed object. ``name`` is unique in the scene: category and number, ``apple_1``.

    ``joints`` are shares of the travel, 0 closed and 1 open, in the order of the asset's joints. ``host`` is the object that
    it rests on or in by ``relation``; empty on the floor and on walls. ``fixed`` objects never move: furniture, appliances,
    wall-mounted objects. ``absent`` objects are outside the world at the start: slicing an object replaces it by its
    ``pieces``.
    """

    name: str
    asset_id: str
    room: str
    pose_world_asset: Pose
    fixed: bool
    joints: tuple[float, ...] = ()
    host: str = ""
    relation: Relation | None = None
    states: frozenset[State] = frozenset()
    substances: frozenset[SubstanceFact] = frozenset()
    absent: bool = False
    pieces: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BackgroundObject:
    """Object that makes a room lived-in: books on a shelf, a towel on the wall. Seen and collided with, never moved or named.

    It collides as the bounding box of its asset. ``host`` is the fixed object that it stands on or in; empty on walls and on
    other background objects.
    """

    asset_id: str
    room: str
    pose_world_asset: Pose
    host: str = ""


@dataclass(frozen=True, slots=True)
class RobotStart:
    """Base of the robot on the floor at the start: world x, y and heading."""

    x_m: float
    y_m: float
    yaw: float
    room: str


@dataclass(frozen=True)
class Scene:
    """Rooms, walls, doorways, windows and objects. The order of ``objects`` is part of the content.

    ``walls`` holds all fixed panels: walls, lintels, sills, panes and the doors that lead outside.
    """

    scene_id: str
    base: str
    seed: int
    rooms: tuple[Room, ...]
    walls: tuple[ConvexPart, ...]
    doorways: tuple[Doorway, ...]
    objects: tuple[SceneObject, ...]
    assets: Mapping[str, Asset]
    robot: RobotStart
    left_out: tuple[str, ...] = field(default=())
    """Inventory items without a place, one sentence each: nothing is dropped silently."""
    windows: tuple[Window, ...] = field(default=())
    background: tuple[BackgroundObject, ...] = field(default=())
    """Objects without a name: tasks, plans and relations never refer to them."""

    @cached_property
    def background_parts(self) -> tuple[ConvexPart, ...]:
        """Bounding box of each background object in the world frame: its shape in a collision."""
        return tuple(
            ConvexPart(Shape.BOX, item.pose_world_asset, self.assets[item.asset_id].size_m)
            for item in self.background
        )

    @cached_property
    def background_boxes(self) -> tuple[Aabb, ...]:
        """World box of each background object."""
        if not self.background:
            return ()
        poses = [item.pose_world_asset for item in self.background]
        turns = {quat: np.abs(Pose((0.0, 0.0, 0.0), quat).rotation) for quat in {p.quat_xyzw for p in poses}}
        halves = np.array([self.assets[item.asset_id].size_m for item in self.background]) / 2  # (n, 3)
        reach = np.einsum("nij,nj->ni", np.array([turns[p.quat_xyzw] for p in poses]), halves)  # (n, 3)
        centers = np.array([p.position_m for p in poses])  # (n, 3)
        rows = np.concatenate([centers - reach, centers + reach], axis=1).tolist()
        return tuple(Aabb((a, b, c), (d, e, f)) for a, b, c, d, e, f in rows)

    @cached_property
    def by_name(self) -> Mapping[str, SceneObject]:
        return {item.name: item for item in self.objects}

    def asset_of(self, name: str) -> Asset:
        """Asset of an object. Raises KeyError for an unknown name."""
        return self.assets[self.by_name[name].asset_id]

    def box_of(self, name: str) -> Aabb:
        """World box of an object with its doors shut. Raises KeyError for an unknown name."""
        pose = self.by_name[name].pose_world_asset
        reach = np.abs(pose.rotation) @ (np.asarray(self.asset_of(name).size_m) / 2)  # (3,)
        center = np.asarray(pose.position_m)
        low, high = (center - reach).tolist(), (center + reach).tolist()
        return Aabb((low[0], low[1], low[2]), (high[0], high[1], high[2]))

    def room_at(self, point: Vec3 | Vec2) -> str:
        """Name of the room under a point; in a wall, the first room within 15 cm; empty outside all rooms."""
        for margin in (0.0, 0.15):
            for room in self.rooms:
                if room.contains(point[0], point[1], margin):
                    return room.name
        return ""
