"""Pieces and groups: the inventory items of a room, arranged into units that are placed as a whole.

A group's frame has x towards the room and y to its left. The wall behind it, if any, is at -x.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np

from embomatrix.factory.assets.corners import is_corner
from embomatrix.factory.furnish.roles import FurnitureRole, importance_of
from embomatrix.factory.furnish.space import Box, Rect4
from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.world.asset import Asset, Link
from embomatrix.world.geometry import ConvexPart, Pose, Vec3
from embomatrix.world.state import Relation

REST_GAP_M: Final = 0.0005
"""Gap between an object and its support: close enough to rest on it, too far to penetrate it."""
FRONT_M: Final = 0.6
_UPENDED: Final = Pose((0.0, 0.0, 0.0), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)))
"""Rotation that turns the face of a flat model from +z of its asset frame to +x."""


class Access(StrEnum):
    """Free space from which the robot uses a piece."""

    NONE = "none"
    BESIDE = "beside"  # some free spot near it
    FRONT = "front"  # a free strip before its front
    HUNG = "hung"  # some free spot near it, and room before it at its own height


@dataclass(frozen=True, slots=True)
class FurniturePiece:
    """One item of a room's inventory. ``number`` identifies it; ``upended`` models hang with their z axis to the room."""

    number: int
    category: str
    asset: Asset
    role: FurnitureRole
    upended: bool = False

    @property
    def size_m(self) -> Vec3:
        """Extent along x, y and z as placed at zero yaw."""
        x, y, z = self.asset.size_m
        return (z, y, x) if self.upended else (x, y, z)

    @property
    def blocks(self) -> tuple[Box, ...]:
        """Boxes it occupies, relative to its centre and underside: one, or the parts of an open shape."""
        open_shape = self.category in _OPEN_SHAPES or is_corner(self.category, self.asset.size_m)
        if open_shape and not self.upended:
            return _blocks_of(self.asset.links[0].parts, self.asset.size_m[2] / 2)
        x, y, z = (extent / 2 for extent in self.size_m)
        return ((-x, -y, 0.0, x, y, 2 * z),)

    def pose(self, x: float, y: float, bottom: float, yaw: float) -> Pose:
        """Return the pose of the asset with its lowest point at height ``bottom``."""
        upright = Pose.from_xyz_yaw(x, y, bottom + self.size_m[2] / 2, yaw)
        return upright @ _UPENDED if self.upended else upright


@dataclass(frozen=True, slots=True)
class Placed:
    """Piece with its place: centre of the footprint, height of the underside, heading, number of its host (-1: none)."""

    piece: FurniturePiece
    room: str
    x: float
    y: float
    bottom: float
    yaw: float
    host: int = -1
    relation: Relation | None = None

    @property
    def pose(self) -> Pose:
        return self.piece.pose(self.x, self.y, self.bottom, self.yaw)

    @property
    def box(self) -> Box:
        """Bounding box in the world."""
        sx, sy, sz = self.piece.size_m
        c, s = abs(math.cos(self.yaw)), abs(math.sin(self.yaw))
        hx, hy = (sx * c + sy * s) / 2, (sx * s + sy * c) / 2
        return (self.x - hx, self.y - hy, self.bottom, self.x + hx, self.y + hy, self.bottom + sz)

    @property
    def boxes(self) -> tuple[Box, ...]:
        """Boxes in the world that the piece occupies at quarter turns; its bounding box at any other heading."""
        blocks = self.piece.blocks
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        if len(blocks) == 1 or abs(c * s) > 1e-6:
            return (self.box,)
        found = []
        for x0, y0, z0, x1, y1, z1 in blocks:
            xs = sorted((c * x0 - s * y0, c * x1 - s * y1))
            ys = sorted((s * x0 + c * y0, s * x1 + c * y1))
            low, high = self.bottom + z0, self.bottom + z1
            found.append((self.x + xs[0], self.y + ys[0], low, self.x + xs[1], self.y + ys[1], high))
        return tuple(found)


@dataclass(frozen=True, slots=True)
class Member:
    """Piece in its group's frame: centre of the footprint, height of the underside, quarter turns.

    ``on`` is the index of the member that carries it, -1 for none.
    """

    piece: FurniturePiece
    x: float = 0.0
    y: float = 0.0
    bottom: float = 0.0
    turns: int = 0
    on: int = -1

    @property
    def half(self) -> tuple[float, float]:
        x, y, _ = self.piece.size_m
        return (y / 2, x / 2) if self.turns % 2 else (x / 2, y / 2)


class Style(StrEnum):
    """Part of the room in which a group is placed."""

    RUN = "run"
    CENTERED = "centered"  # at the middle of a wall
    ALONG = "along"  # anywhere along a wall
    CORNER = "corner"
    NOOK = "nook"  # in a corner with the right side at the other wall
    FREE = "free"  # in the middle of the room
    EDGE = "edge"  # along the walls, or in front of furniture there
    AISLE = "aisle"  # lines across the room, an aisle apart
    OVERHEAD = "overhead"


@dataclass(frozen=True, slots=True)
class FurnitureGroup:
    """Pieces that are placed as one.

    A place is better the closer it is to categories in ``near``, the better it sees those in ``faces``, and the farther it is
    from those in ``spread``. ``clear_m`` is free floor on all sides.
    """

    members: tuple[Member, ...]
    style: Style
    importance: float
    near: tuple[str, ...] = ()
    faces: tuple[str, ...] = ()
    spread: tuple[str, ...] = field(default=())
    clear_m: float = 0.0

    @property
    def bounds(self) -> Rect4:
        """(x0, y0, x1, y1) of all footprints in the group's frame."""
        low = np.min([(m.x - m.half[0], m.y - m.half[1]) for m in self.members], axis=0)
        high = np.max([(m.x + m.half[0], m.y + m.half[1]) for m in self.members], axis=0)
        return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


@dataclass(frozen=True, slots=True)
class Rows:
    """Equal groups in rows and columns with one heading. ``gap_m`` is the free floor behind and beside each.

    They spread over the room up to ``stretch`` times their closest pitch. ``clear_m`` is free floor to other furniture.
    """

    groups: tuple[FurnitureGroup, ...]
    importance: float
    gap_m: tuple[float, float]
    stretch: float = 1.35
    clear_m: float = 0.0


_FRONTED_NAMES: Final = (
    "fridge freezer oven stove dishwasher washer clothes_dryer furniture_sink commercial_kitchen_sink toilet pedestal_sink "
    "multi_station_furniture_sink flat_top_grill deep_fryer bookcase jukebox wardrobe urinal electric_cauldron "
    "vending_machine grocery_shelf photocopier locker wall_mounted_sink"
)
_FRONTED: Final = frozenset(_FRONTED_NAMES.split())
_BESIDE: Final = frozenset((FurnitureRole.TABLE, FurnitureRole.LOW_TABLE, FurnitureRole.FITTED))


def access_of(piece: FurniturePiece) -> Access:
    """Return the access of a piece: a free front to open or operate it, or floor beside it to put objects on it."""
    if piece.role is FurnitureRole.SURFACE:
        return Access.NONE
    if piece.role is FurnitureRole.HUNG_CABINET:
        return Access.HUNG if piece.asset.can("openable") else Access.NONE
    if piece.category in _FRONTED or piece.asset.can("openable"):
        return Access.FRONT
    if piece.role in _BESIDE or piece.category in (
        "bed",
        "sofa",
        "armchair",
        "countertop",
        "bar",
        "commercial_kitchen_table",
        "shower_stall",
        "bathtub",
    ):
        return Access.BESIDE
    return Access.NONE


_OPEN_SHAPES: Final = frozenset(("tree", "low_resolution_tree"))
"""Categories with free space below: a tree occupies its trunk and its crown, not the box around both."""


@functools.lru_cache(maxsize=1024)
def _blocks_of(parts: tuple[ConvexPart, ...], half_m: float) -> tuple[Box, ...]:
    """Return boxes around the parts of an asset, with heights above its underside."""
    boxes = [part.aabb(Pose((0.0, 0.0, half_m))) for part in parts]
    return tuple((*box.low_m, *box.high_m) for box in boxes)


def front_depth_m(asset: Asset) -> float:
    """Return the free depth before the front: 0.6 m, or the reach of doors and drawers up to 1 m."""
    return max(FRONT_M, min(_furthest_out(asset.links) - asset.size_m[0] / 2 + 0.02, 1.0))


@functools.lru_cache(maxsize=4096)
def _furthest_out(links: tuple[Link, ...]) -> float:
    """Return the largest x that moving links reach on their travel, from the asset's centre."""
    out = 0.0
    for link in links:
        if link.joint is None:
            continue
        for fraction in (0.5, 1.0):
            moved = joint_motion(link.joint, fraction)
            out = max([out, *(part.aabb(moved).high_m[0] for part in link.parts)])
    return out


def top_of(piece: FurniturePiece) -> float:
    """Return the height of the piece's largest open surface above its underside; its full height if it has none."""
    half = piece.asset.size_m[2] / 2
    tops = [(s.size_m[0] * s.size_m[1], s.center_m[2] + half) for s in piece.asset.supports if not s.walled]
    return max(tops)[1] if tops else piece.asset.size_m[2]


def stacked(base: Member, piece: FurniturePiece, index: int) -> Member:
    """Return the piece centred on top of ``base``, the group's member at ``index``."""
    return Member(piece, base.x, base.y, base.bottom + top_of(base.piece) + REST_GAP_M, base.turns, on=index)


def around_table(
    table: FurniturePiece, chairs: Sequence[FurniturePiece], gap_m: float = 0.04
) -> tuple[Member, ...]:
    """Return a table with chairs facing it: along the long sides first, then at the ends."""
    side, end = _places(table, max((c.size_m[1] for c in chairs), default=0.5))
    ends = end if len(chairs) > 2 * side else 0
    counts = _seats(len(chairs), (side, side, ends, ends))
    members = [Member(table)]
    rest = list(chairs)
    for direction, count in zip((0, 2, 1, 3), counts, strict=True):
        members += _line(table, rest[:count], direction, gap_m)
        rest = rest[count:]
    return tuple(members)


def before_table(
    table: FurniturePiece, chairs: Sequence[FurniturePiece], gap_m: float = 0.04
) -> tuple[Member, ...]:
    """Return a table with chairs on its front side only, facing it: a workplace, a row of a class."""
    return (Member(table), *_line(table, list(chairs), 0, gap_m))


def seats_around(table: FurniturePiece, seat_m: float) -> int:
    """Return the number of chairs of this width that fit around the table."""
    side, end = _places(table, seat_m)
    return 2 * (side + end)


def _places(table: FurniturePiece, seat_m: float) -> tuple[int, int]:
    """Return the number of chairs along a long side and at an end of the table."""
    depth, width, _ = table.size_m
    seat = seat_m + 0.08
    return max(1, int(width / seat)), max(0, int(depth / seat))


def _line(
    table: FurniturePiece, chairs: Sequence[FurniturePiece], direction: int, gap_m: float
) -> list[Member]:
    """Return chairs side by side at the table's side that is ``direction`` quarter turns from its front."""
    depth, width, _ = table.size_m
    across, run = (depth, width) if direction % 2 == 0 else (width, depth)
    seat = max((c.size_m[1] for c in chairs), default=0.5) + 0.08
    members = []
    for place, chair in enumerate(chairs):
        offset = across / 2 + gap_m + chair.size_m[0] / 2
        shift = ((place + 0.5) / len(chairs) - 0.5) * max(run, len(chairs) * seat)
        x, y = ((offset, shift), (shift, offset), (-offset, shift), (shift, -offset))[direction]
        members.append(Member(chair, x, y, turns=(direction + 2) % 4))
    return members


def _seats(chairs: int, places: tuple[int, int, int, int]) -> tuple[int, ...]:
    """Return the chairs per side: the two long sides share them evenly, the ends take the rest."""
    counts = [0, 0, 0, 0]
    for _ in range(chairs):
        open_sides = [i for i in range(4) if counts[i] < places[i]]
        if not open_sides:
            break
        pick = min(open_sides, key=lambda i: (i >= 2, counts[i]))
        counts[pick] += 1
    return tuple(counts)


class Pool:
    """Pieces of a room that no group has taken yet, with the room's type and floor size."""

    def __init__(
        self, pieces: Iterable[FurniturePiece], room_type: str = "", floor_m: tuple[float, float] = (5.0, 5.0)
    ) -> None:
        self.rest = list(pieces)
        self.room_type = room_type
        self.floor_m = floor_m

    def of(self, *categories: str) -> list[FurniturePiece]:
        return [p for c in categories for p in self.rest if p.category == c]

    def with_role(self, *roles: FurnitureRole) -> list[FurniturePiece]:
        return [p for p in self.rest if p.role in roles]

    def take(self, pieces: Iterable[FurniturePiece]) -> list[FurniturePiece]:
        """Remove the pieces from the pool and return them."""
        taken = list(pieces)
        numbers = {p.number for p in taken}
        self.rest = [p for p in self.rest if p.number not in numbers]
        return taken


def worth(members: Sequence[Member]) -> float:
    """Return the importance of a group: that of its best member, plus 0.1 for each member."""
    return max(importance_of(m.piece.category, m.piece.role) for m in members) + 0.1 * len(members)
