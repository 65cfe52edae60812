"""Poses at which one asset might stand on, in or under another: spread evenly, by geometry alone."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bounds import IDENTITY, AssetBounds
from embomatrix.sim.spots import interior_around, is_under, surface_under
from embomatrix.world.asset import SupportSurface
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Vec2, Vec3

GOLDEN: Final = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence: its first n points are spread over the square about as well as Poisson discs."""
LIFT_M: Final = 0.0005
"""Objects start this high over their surface, so that none begins in contact."""
EDGE_M: Final = 0.005
"""Free strip between an object and the edge of its surface, and below the ceiling of its space."""
SUPPORTED_SHARE: Final = 0.6
"""A thing wider than its surface needs at least this share of its width on it."""
YAWS: Final = (0.0, math.pi / 2, math.pi, -math.pi / 2)
"""Things stand square to what they stand on."""


def surfaces_for(asset: Asset, relation: Relation) -> tuple[SupportSurface, ...]:
    """Where ``relation`` to the asset puts a thing, in the asset's frame; empty when it can't.

    On top: supports that no door shuts off, or the top of the box of an asset without any. Inside: supports within
    cavities, and the floors of cavities without. Under: the floor that the asset stands on.
    """
    doored = {interior.name for interior in asset.interiors if interior.closed_by}
    x, y, z = asset.size_m
    match relation:
        case Relation.ONTOP:
            if not asset.supports:
                return (SupportSurface("", (0.0, 0.0, z / 2), (x, y), math.inf),)
            return tuple(surface for surface in asset.supports if surface.interior not in doored)
        case Relation.INSIDE:
            inner = tuple(surface for surface in asset.supports if surface.interior)
            furnished = {surface.interior for surface in inner}
            bare = tuple(item for item in asset.interiors if item.name not in furnished)
            return inner + tuple(
                SupportSurface(
                    item.name,
                    (item.center_m[0], item.center_m[1], item.center_m[2] - item.size_m[2] / 2),
                    (item.size_m[0], item.size_m[1]),
                    item.size_m[2] if item.closed_by else math.inf,
                    item.name,
                )
                for item in bare
            )
        case Relation.UNDER:
            return (SupportSurface("", (0.0, 0.0, -z / 2), (x, y), math.inf),)
        case _:
            return ()


def candidates(held: Asset, support: Asset, relation: Relation, shift: Vec2, tries: int) -> Iterator[Pose]:
    """Poses of ``held`` in the frame of ``support`` at which the relation holds, its surfaces taken in turn.

    At most ``tries`` poses are looked at. ``shift`` in the unit square moves the whole pattern: equal shifts give equal
    poses.
    """
    bounds = AssetBounds(held)
    boxes = [bounds.box(Pose.from_xyz_yaw(0.0, 0.0, 0.0, yaw)) for yaw in YAWS]
    # Yaws turn slowest: the first round visits every surface once.
    rooms = [
        (surface, yaw, box, room)
        for yaw, box in zip(YAWS, boxes, strict=True)
        for surface in surfaces_for(support, relation)
        if (room := _room_for(box, surface)) is not None
    ]
    for number, (surface, yaw, box, room) in zip(range(1, tries + 1), itertools.cycle(rooms), strict=False):
        u, v = ((start + number * step) % 1.0 for start, step in zip(shift, GOLDEN, strict=True))
        x = surface.center_m[0] - box.center_m[0] + (2 * u - 1) * room[0]
        y = surface.center_m[1] - box.center_m[1] + (2 * v - 1) * room[1]
        z = surface.center_m[2] - box.low_m[2] + LIFT_M
        if _stands(box, (x, y, z), support, relation):
            yield Pose.from_xyz_yaw(x, y, z, yaw)


def stands_in(held: Asset, pose_support_held: Pose, support: Asset, relation: Relation) -> bool:
    """Whether the relation holds between two assets, joints shut, by the definitions of ``relations``."""
    return _stands(AssetBounds(held).box(pose_support_held), (0.0, 0.0, 0.0), support, relation)


def _stands(box: Aabb, offset: Vec3, support: Asset, relation: Relation) -> bool:
    low, high = (
        tuple(value + more for value, more in zip(corner, offset, strict=True))
        for corner in (box.low_m, box.high_m)
    )
    moved = Aabb((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    match relation:
        case Relation.ONTOP:
            return bool(surface_under(moved, support, IDENTITY, doored=False))
        case Relation.INSIDE:
            return interior_around(moved, support) is not None
        case Relation.UNDER:
            return is_under(moved, support, IDENTITY)
        case _:
            return False


def _room_for(box: Aabb, surface: SupportSurface) -> Vec2 | None:
    """How far the box's centre may be from the surface's along x and y; None when it does not fit.

    In a cavity the whole footprint must fit; in the open a wide thing may stand over both edges, in the middle.
    """
    width, depth, height = box.size_m
    if height + EDGE_M > surface.clearance_m:
        return None
    room = []
    for extent, free in zip((width, depth), surface.size_m, strict=True):
        if (surface.interior and extent > free) or free < SUPPORTED_SHARE * extent:
            return None
        room.append(max(0.0, (free - extent) / 2 - EDGE_M))
    return (room[0], room[1])
