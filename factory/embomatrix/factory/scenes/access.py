"""Access to furniture: the robot needs floor before or beside furniture that opens, works or carries objects."""

import math
from collections.abc import Container, Iterator
from dataclasses import replace
from typing import Final

from embomatrix.factory.furnish.pieces import Access, FurniturePiece, access_of
from embomatrix.factory.furnish.roles import FurnitureRole, role_of
from embomatrix.factory.scenes.floor import ReachableFloor, box_of
from embomatrix.world.scene import Scene, SceneObject

# These reasons are content of a scene, so its digest depends on their wording.
_NO_FRONT: Final = "nobody could stand before its front"
_NO_HOST: Final = "it lay in a cabinet that nobody could stand before"
_AT_TABLE_M: Final = 1.0
"""Distance within which a seat can block the floor beside a table."""


def unserved(scene: Scene, floor: ReachableFloor) -> Iterator[tuple[SceneObject, Access]]:
    """Yield furniture without a reachable place for the robot, and the access that it needs."""
    for item in scene.objects:
        access = _access(scene, item)
        if access is Access.NONE:
            continue
        front = None if access is Access.BESIDE else item.pose_world_asset
        box = floor.boxes.whole(scene.assets[item.asset_id], item.pose_world_asset)
        if not len(floor.spots(box, front_of=front)):
            yield item, access


def with_all_served(scene: Scene) -> Scene:
    """Remove furniture so that the robot can use all that is left; ``left_out`` names each removed object.

    Furnishing requires floor near a wall cabinet, but that floor may be round a corner: the cabinet and its contents are
    removed. It requires floor beside a table before the chairs of other tables are placed: one blocking chair is removed.
    """
    lost: dict[str, str] = {}
    for item, access in unserved(scene, ReachableFloor(scene)):
        if access is Access.HUNG:
            lost[item.name] = _NO_FRONT
        elif access is Access.BESIDE and (seat := _seat_in_the_way(scene, item)):
            lost[seat] = f"it stood where one gets at {item.name}"
    if not lost:
        return scene
    # A host precedes its contents in the scene, so one pass finds nested contents.
    for item in scene.objects:
        if item.host in lost:
            lost[item.name] = _NO_HOST
    notes = (
        f"1 {scene.by_name[name].asset_id} in {scene.by_name[name].room}: {why}" for name, why in lost.items()
    )
    left = _without(scene, lost)
    return replace(left, left_out=(*left.left_out, *notes))


def _seat_in_the_way(scene: Scene, table: SceneObject) -> str:
    """Return the nearest empty seat whose removal gives the robot a place beside the table; "" if there is none."""
    box = box_of(scene, table)
    near = box.grown(_AT_TABLE_M)
    hosts = {item.host for item in scene.objects}
    seats = [
        (math.dist(box_of(scene, item).center_m, box.center_m), item.name)
        for item in scene.objects
        if _role(scene, item) is FurnitureRole.SEAT
        and item.name not in hosts
        and box_of(scene, item).overlaps(near)
    ]
    for _, name in sorted(seats):
        if len(ReachableFloor(_without(scene, {name})).spots(box)):
            return name
    return ""


def _without(scene: Scene, names: Container[str]) -> Scene:
    left = tuple(item for item in scene.objects if item.name not in names)
    used = {item.asset_id for item in left}
    return replace(
        scene, objects=left, assets={each: asset for each, asset in scene.assets.items() if each in used}
    )


def _access(scene: Scene, item: SceneObject) -> Access:
    asset = scene.assets[item.asset_id]
    return access_of(FurniturePiece(0, asset.category, asset, _role(scene, item)))


def _role(scene: Scene, item: SceneObject) -> FurnitureRole:
    asset = scene.assets[item.asset_id]
    return role_of(asset.category, asset.size_m, asset.mass_kg)
