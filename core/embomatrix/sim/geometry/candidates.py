"""Candidate poses of one asset on, in or under another, spread evenly by geometry alone."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.sim.geometry.bounds import AssetBounds, bounds_of
from embomatrix.sim.geometry.surfaces import interior_around, is_under, surface_under
from embomatrix.world.asset import Asset, SupportSurface
from embomatrix.world.geometry import IDENTITY, Aabb, FloatArray, Pose, Vec2, Vec3
from embomatrix.world.state import Relation

GOLDEN: Final = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence: its first n points cover the square about as evenly as Poisson discs."""
LIFT_M: Final = 0.0005
"""Initial height over the surface, which avoids initial contact."""
EDGE_M: Final = 0.005
"""Free strip between an object and the edge of its surface, and below the ceiling of its space."""
SUPPORTED_SHARE: Final = 0.6
"""An object wider than its surface needs at least this share of its width on it."""
BESIDE_M: Final = 0.02
"""Gap beside a neighbour: less than half of what ``nextto`` allows the smallest object, more than contact."""
PLACE_RELATIONS: Final = (Relation.ONTOP, Relation.INSIDE, Relation.UNDER)
"""Relations that placing on, in or under a support creates. Places next to an object depend on its surroundings."""
YAWS: Final = (0.0, math.pi / 2, math.pi, -math.pi / 2)
"""Objects stand square to their support."""


def surfaces_for(asset: Asset, relation: Relation) -> tuple[SupportSurface, ...]:
    """Surfaces for an object with this relation to the asset, in the asset's frame; empty for none.

    On top: supports outside cavities, or the top of the box of an asset without supports. Inside: supports within cavities,
    and the floors of the other cavities. Under: the floor below the asset.
    """
    x, y, z = asset.size_m
    match relation:
        case Relation.ONTOP:
            if not asset.supports:
                return (SupportSurface("", (0.0, 0.0, z / 2), (x, y), math.inf),)
            return asset.open_supports
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
                    item.link,
                )
                for item in bare
            )
        case Relation.UNDER:
            return (SupportSurface("", (0.0, 0.0, -z / 2), (x, y), math.inf),)
        case _:
            return ()


@dataclass(frozen=True, slots=True)
class Patch:
    """Range of poses of an asset on one surface at one yaw.

    ``center_m`` is the middle of the poses in the frame of the support's ``link``; they extend up to ``room_m`` from it along
    x and y.
    """

    center_m: Vec3
    room_m: Vec2
    yaw: float
    link: str


def patches(bounds: AssetBounds, support: Asset, relation: Relation) -> tuple[Patch, ...]:
    """Patches for an object with these bounds in the relation to a support. Yaws vary slowest: each visits every surface."""
    found: list[Patch] = []
    for yaw in YAWS:
        box = bounds.box(Pose.from_xyz_yaw(0.0, 0.0, 0.0, yaw))
        x, y, _ = box.center_m
        for surface in surfaces_for(support, relation):
            room = _room_for(box, surface)
            if room is not None:
                cx, cy, cz = surface.center_m
                center = (cx - x, cy - y, cz - box.low_m[2] + LIFT_M)
                found.append(Patch(center, room, yaw, surface.link))
    return tuple(found)


def proposed_places(found: Sequence[Patch], shift: Vec2, tries: int) -> FloatArray:
    """Positions of ``tries`` poses on the links of a support, shape (n, 3), the patches taken in turn; empty without a patch.

    ``shift`` in the unit square moves the whole pattern: equal shifts give equal poses. The relation is not checked.
    """
    if not found:
        return np.zeros((0, 3))
    centers = np.array([patch.center_m for patch in found])  # (p, 3)
    rooms = np.array([patch.room_m for patch in found])  # (p, 2)
    return spread_over(centers, rooms, shift, tries)


def spread_over(centers_m: FloatArray, rooms_m: FloatArray, shift: Vec2, tries: int) -> FloatArray:
    """Evaluate ``proposed_places`` for patches given by their centres, shape (p, 3), and rooms, shape (p, 2)."""
    if not len(centers_m):
        return np.zeros((0, 3))
    rows = np.arange(tries) % len(centers_m)
    places = centers_m[rows]  # (n, 3)
    spread = (np.array(shift) + np.arange(1, tries + 1)[:, None] * np.array(GOLDEN)) % 1.0
    places[:, :2] += (2 * spread - 1) * rooms_m[rows]
    return np.asarray(places, dtype=np.float64)


def candidates(held: Asset, support: Asset, relation: Relation, shift: Vec2, tries: int) -> Iterator[Pose]:
    """Poses at proposed places, from which the object comes to rest in the relation."""
    bounds = bounds_of(held)
    found = patches(bounds, support, relation)
    places = proposed_places(found, shift, tries).tolist()
    for patch, (x, y, z) in zip(itertools.cycle(found), places, strict=False):
        at_rest = Pose.from_xyz_yaw(x, y, z - LIFT_M, patch.yaw)
        if _stands(bounds.box(at_rest), support, relation):
            yield Pose.from_xyz_yaw(x, y, z, patch.yaw)


def beside(held: Asset, support: Asset, relation: Relation, neighbour: Aabb) -> Iterator[Pose]:
    """Poses with the relation right beside a box in the support's frame, along each of its sides."""
    bounds = bounds_of(held)
    for patch in patches(bounds, support, relation):
        if patch.link:
            continue  # a drawer's contents move away from static neighbours
        box = bounds.box(Pose.from_xyz_yaw(0.0, 0.0, 0.0, patch.yaw))
        for place in places_beside(box, neighbour, BESIDE_M):
            pose = Pose.from_xyz_yaw(*place, patch.center_m[2], patch.yaw)
            if _within(patch, place) and _stands(bounds.box(pose), support, relation):
                yield pose


def places_beside(box: Aabb, neighbour: Aabb, gap_m: float, shares: Sequence[float] = ()) -> Iterator[Vec2]:
    """Positions of an object at which there is a gap between a neighbour's box and its own, along each side of the neighbour.

    ``box`` is the object's own with its origin at zero. ``shares`` are further offsets from the middle of a side: at 1 the
    object stands at the corner.
    """
    middle = neighbour.center_m
    for axis, sign in itertools.product((0, 1), (1, -1)):
        off = (neighbour.size_m[axis] + box.size_m[axis]) / 2 + gap_m
        side_m, extent_m = neighbour.size_m[1 - axis], box.size_m[1 - axis]
        further = (share * (side_m + extent_m) / 2 for share in shares)
        for along in (*_along(side_m, extent_m), *further):
            place = [0.0, 0.0]
            place[axis] = middle[axis] + sign * off - box.center_m[axis]
            place[1 - axis] = middle[1 - axis] + along - box.center_m[1 - axis]
            yield (place[0], place[1])


def _along(side_m: float, extent_m: float) -> list[float]:
    """Offsets along a side at which several objects of one extent stand in a row, the middle one first."""
    step = extent_m + BESIDE_M
    reach = int(side_m / 2 / step)
    return sorted((number * step for number in range(-reach, reach + 1)), key=abs)


def _within(patch: Patch, place: Sequence[float]) -> bool:
    return all(
        abs(at - center) <= room + EDGE_M
        for at, center, room in zip(place, patch.center_m[:2], patch.room_m, strict=True)
    )


def stands_in(held: Asset, pose_support_held: Pose, support: Asset, relation: Relation) -> bool:
    """Return True if the relation holds between two assets with joints shut, as defined in ``relations``."""
    return _stands(bounds_of(held).box(pose_support_held), support, relation)


def _stands(box: Aabb, support: Asset, relation: Relation) -> bool:
    match relation:
        case Relation.ONTOP:
            return not interior_around(box, support) and bool(
                surface_under(box, support, IDENTITY, in_cavities=False)
            )
        case Relation.INSIDE:
            return interior_around(box, support) is not None
        case Relation.UNDER:
            return is_under(box, support, IDENTITY)
        case _:
            return False


def _room_for(box: Aabb, surface: SupportSurface) -> Vec2 | None:
    """Largest offset of the box's centre from the surface's along x and y; None if the box does not fit.

    Between walls the whole footprint must fit; in the open a wide object may extend over both edges.
    """
    width, depth, height = box.size_m
    if height + EDGE_M > surface.clearance_m:
        return None
    room = []
    for extent, free in zip((width, depth), surface.size_m, strict=True):
        if (surface.walled and extent > free) or free < SUPPORTED_SHARE * extent:
            return None
        room.append(max(0.0, (free - extent) / 2 - EDGE_M))
    return (room[0], room[1])
