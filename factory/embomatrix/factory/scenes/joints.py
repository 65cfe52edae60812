"""Opening and closing a scene's furniture together with the objects carried by its moving links."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from embomatrix.factory.assets.solids import Solids, placed_parts
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.surfaces import link_frame, link_under, links_with_surfaces
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import Pose
from embomatrix.world.scene import Scene, SceneObject


def with_joints(
    objects: Mapping[str, SceneObject], assets: Mapping[str, Asset], name: str, fractions: Sequence[float]
) -> dict[str, SceneObject]:
    """Set an object's joints; return the object and all carried objects at their new poses, by name.

    ``fractions`` are shares of the joints' travel, one for each joint; ``assets`` are keyed by id. Hosts and relations decide
    which objects a link carries, contents of contents included. Raises KeyError for an unknown name.
    """
    item = objects[name]
    asset, base = assets[item.asset_id], item.pose_world_asset
    changed = {name: replace(item, joints=tuple(float(share) for share in fractions))}
    for link in sorted(links_with_surfaces(asset) - {""}):
        before = link_frame(asset, base, item.joints, link)
        motion = link_frame(asset, base, changed[name].joints, link) @ before.inverse()
        for carried in _carried_by_link(objects, assets, name, before, link):
            for each in _with_contents(objects, carried):
                changed[each.name] = replace(each, pose_world_asset=motion @ each.pose_world_asset)
    return changed


def bumped_into(scene: Scene, solids: Solids, name: str, fractions: Sequence[float]) -> frozenset[str]:
    """Return the owners of solids that the object or its carried objects would newly penetrate with its joints set."""
    before = scene.by_name
    found: set[str] = set()
    changed = with_joints(before, scene.assets, name, fractions)
    for item in changed.values():
        asset, was = scene.asset_of(item.name), before[item.name]
        there = solids.overlaps(placed_parts(asset, item.pose_world_asset, item.joints))
        here = solids.overlaps(placed_parts(asset, was.pose_world_asset, was.joints))
        found |= there.keys() - here.keys()
    return frozenset(found - changed.keys())


def _carried_by_link(
    objects: Mapping[str, SceneObject], assets: Mapping[str, Asset], host: str, frame: Pose, link: str
) -> Iterator[SceneObject]:
    """Yield the objects that lie on or in a link of the host. ``frame`` is the link's frame."""
    asset = assets[objects[host].asset_id]
    for item in objects.values():
        if item.host == host and item.relation is not None:
            box = bounds_of(assets[item.asset_id]).box(frame.inverse() @ item.pose_world_asset)
            if link_under(box, asset, item.relation) == link:
                yield item


def _with_contents(objects: Mapping[str, SceneObject], item: SceneObject) -> Iterator[SceneObject]:
    yield item
    for other in objects.values():
        if other.host == item.name:
            yield from _with_contents(objects, other)
