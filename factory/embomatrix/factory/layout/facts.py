"""Facts about a scene for the agents' briefs: rooms, and the spaces that furniture offers."""

import math
from collections.abc import Container, Iterator
from typing import Final

from embomatrix.factory.furnish.small_objects import HOST_GROUPS
from embomatrix.factory.layout.organization import HIGHEST_M, LOWEST_M
from embomatrix.factory.layout.values import HostFacts, HostOffer, LayoutRelation, LayoutRoomFacts, Size3
from embomatrix.factory.scenes.editor import SceneEditor
from embomatrix.sim.geometry.candidates import EDGE_M, surfaces_for
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset, SupportSurface
from embomatrix.world.state import Relation

OFFERED: Final = (LayoutRelation.ONTOP, LayoutRelation.INSIDE, LayoutRelation.UNDER)
MIN_SPACE_M: Final = 0.08
"""Narrower spaces are not offered."""
MIN_UNDER_M: Final = 0.05
"""Free height below an object from which on objects can go under it."""


def rooms_of(editor: SceneEditor) -> tuple[LayoutRoomFacts, ...]:
    """Return all rooms of the scene with the categories of the objects that can hold others."""
    furniture: dict[str, list[str]] = {name: [] for name in editor.rooms}
    for item in editor.objects.values():
        asset = editor.asset_of(item.name)
        if item.fixed and (asset.supports or asset.interiors):
            furniture.setdefault(item.room, []).append(asset.category)
    return tuple(
        LayoutRoomFacts(name, room.type, room.size_m, tuple(sorted(furniture[name])))
        for name, room in editor.rooms.items()
    )


def hosts_in(editor: SceneEditor, room: str, named: Container[str] = ()) -> Iterator[HostFacts]:
    """Yield the possible hosts in a room: furniture that people put objects on or in, and objects that the task names.

    Furniture that the robot can't reach is left out.
    """
    contents: dict[str, list[str]] = {}
    for item in editor.objects.values():
        if item.host:
            contents.setdefault(item.host, []).append(editor.asset_of(item.name).category)
    for item in editor.objects.values():
        asset = editor.asset_of(item.name)
        if item.name not in named:
            unused = HOST_GROUPS.get(asset.category) == frozenset()
            if item.room != room or not item.fixed or unused or item.name in editor.unserved:
                continue
        offers = _offers(asset, round(item.pose_world_asset.position_m[2], 3), is_named=item.name in named)
        closed = any(interior.closed_by for interior in asset.interiors)
        given = item.name in named or item.name not in editor.base.by_name
        if closed and not given and not editor.view.opens(item.name):
            offers = tuple(offer for offer in offers if offer.relation is not LayoutRelation.INSIDE)
        if offers:
            yield HostFacts(item.name, asset.category, offers, tuple(contents.get(item.name, ())), closed)


def _offers(asset: Asset, base_m: float, *, is_named: bool) -> tuple[HostOffer, ...]:
    highest_m = ROBOT.reach_high_m if is_named else HIGHEST_M
    found = (_offer(asset, relation, base_m, highest_m) for relation in OFFERED)
    return tuple(
        offer
        for offer in found
        if offer is not None
        and (is_named or (bool(asset.supports) and LOWEST_M <= offer.height_m <= HIGHEST_M))
    )


def _offer(asset: Asset, relation: LayoutRelation, base_m: float, highest_m: float) -> HostOffer | None:
    under = relation is LayoutRelation.UNDER
    if under and _height_below_m(asset) < MIN_UNDER_M:
        return None
    surfaces = [
        surface
        for surface in surfaces_for(asset, Relation(relation.value))
        if min(surface.size_m) >= MIN_SPACE_M and (under or base_m + surface.center_m[2] <= highest_m)
    ]
    if not surfaces:
        return None
    # A low shelf of tall furniture must not exclude the higher shelves.
    heights = [base_m + surface.center_m[2] for surface in surfaces]
    height = min((h for h in heights if h >= LOWEST_M), default=min(heights))
    return HostOffer(relation, tuple(_space(surface) for surface in surfaces), round(height, 3))


def _space(surface: SupportSurface) -> Size3:
    """Return the free extents along x and y and the free height on a surface."""
    x, y = surface.size_m
    high = surface.clearance_m - EDGE_M if math.isfinite(surface.clearance_m) else 9.0
    return (x - 2 * EDGE_M, y - 2 * EDGE_M, high)


def _height_below_m(asset: Asset) -> float:
    """Return the free height below the centre of an asset's base."""
    low = -asset.size_m[2] / 2
    over = [
        part.pose.position_m[2] - part.size_m[2] / 2 - low
        for part in asset.links[0].parts
        if all(
            abs(middle) <= extent / 2
            for middle, extent in zip(part.pose.position_m[:2], part.size_m[:2], strict=True)
        )
    ]
    return min(over, default=0.0)
