"""Opening and shutting a scene's furniture: what lies in a drawer comes along with it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from embomatrix.factory.assets.solids import placed_parts
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.surfaces import link_frame, link_under, links_with_surfaces

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from embomatrix.factory.assets.solids import Solids
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Pose
    from embomatrix.world.scene import Scene, SceneObject


def with_joints(
    objects: Mapping[str, SceneObject], assets: Mapping[str, Asset], name: str, fractions: Sequence[float]
) -> dict[str, SceneObject]:
    """What changes when an object's joints are set: the object, and all that rides on its links, by name.

    ``fractions`` are shares of the joints' travel, one for each; ``assets`` are given by their ids. Things ride that the
    objects' hosts and relations say lie there, with whatever lies on or in them. Raises KeyError for an unknown name.
    """
    item = objects[name]
    asset, base = assets[item.asset_id], item.pose_world_asset
    changed = {name: replace(item, joints=tuple(float(share) for share in fractions))}
    for link in sorted(links_with_surfaces(asset) - {""}):
        before = link_frame(asset, base, item.joints, link)
        motion = link_frame(asset, base, changed[name].joints, link) @ before.inverse()
        for rider in _riders(objects, assets, name, before, link):
            for guest in _with_guests(objects, rider):
                changed[guest.name] = replace(guest, pose_world_asset=motion @ guest.pose_world_asset)
    return changed


def bumped_into(scene: Scene, solids: Solids, name: str, fractions: Sequence[float]) -> frozenset[str]:
    """Owners of solids that an object, or what rides on it, would be in with its joints set, and is not in as it stands."""
    before = scene.by_name
    found: set[str] = set()
    changed = with_joints(before, scene.assets, name, fractions)
    for item in changed.values():
        asset, was = scene.asset_of(item.name), before[item.name]
        there = solids.overlaps(placed_parts(asset, item.pose_world_asset, item.joints))
        here = solids.overlaps(placed_parts(asset, was.pose_world_asset, was.joints))
        found |= there.keys() - here.keys()
    return frozenset(found - changed.keys())


def _riders(
    objects: Mapping[str, SceneObject], assets: Mapping[str, Asset], host: str, frame: Pose, link: str
) -> Iterator[SceneObject]:
    """Guests of an object that lie on or in one of its links, whose frame is given."""
    asset = assets[objects[host].asset_id]
    for guest in objects.values():
        if guest.host == host and guest.relation is not None:
            box = bounds_of(assets[guest.asset_id]).box(frame.inverse() @ guest.pose_world_asset)
            if link_under(box, asset, guest.relation) == link:
                yield guest


def _with_guests(objects: Mapping[str, SceneObject], item: SceneObject) -> Iterator[SceneObject]:
    yield item
    for guest in objects.values():
        if guest.host == item.name:
            yield from _with_guests(objects, guest)
