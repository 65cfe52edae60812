"""What the robot can get at: furniture that opens, works or carries things needs a place to stand before or beside it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from embomatrix.factory.furnish.pieces import Access, Piece, access_of
from embomatrix.factory.furnish.roles import role_of
from embomatrix.factory.scenes.floor import ReachableFloor, box_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.world.scene import Scene, SceneObject

_NO_FRONT: Final = "nobody could stand before its front"
_NO_HOST: Final = "it lay in a cabinet that nobody could stand before"


def unserved(scene: Scene, floor: ReachableFloor) -> Iterator[tuple[SceneObject, Access]]:
    """Furniture without a reachable place to stand, and which access it needs."""
    for item in scene.objects:
        access = _access(scene, item)
        if access is Access.NONE:
            continue
        front = None if access is Access.BESIDE else item.pose_world_asset
        if not len(floor.spots(box_of(scene, item), front_of=front)):
            yield item, access


def without_unserved_cabinets(scene: Scene) -> Scene:
    """The scene without cabinets on a wall that nobody can stand before, and what lies in them, each told in ``left_out``.

    Furnishing asks for floor near them, which may lie round a corner.
    """
    if not any(_access(scene, item) is Access.HUNG for item in scene.objects):
        return scene
    lost = {
        item.name: _NO_FRONT
        for item, access in unserved(scene, ReachableFloor(scene))
        if access is Access.HUNG
    }
    if not lost:
        return scene
    # hosts stand before what they bear: one pass finds what lies in what lies in them
    for item in scene.objects:
        if item.host in lost:
            lost[item.name] = _NO_HOST
    left = tuple(item for item in scene.objects if item.name not in lost)
    used = {item.asset_id for item in left}
    assets = {asset_id: asset for asset_id, asset in scene.assets.items() if asset_id in used}
    gone = (scene.by_name[name] for name in lost)
    notes = (f"1 {item.asset_id} in {item.room}: {lost[item.name]}" for item in gone)
    return replace(scene, objects=left, assets=assets, left_out=(*scene.left_out, *notes))


def _access(scene: Scene, item: SceneObject) -> Access:
    asset = scene.assets[item.asset_id]
    return access_of(Piece(0, asset.category, asset, role_of(asset.category, asset.size_m, asset.mass_kg)))
