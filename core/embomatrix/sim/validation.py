"""Checks of a scene before physics loads it: Bullet silently accepts NaN, unknown ids and a 17th part."""

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

from embomatrix.sim.engine import BACKGROUND, FLOOR, WALL, EngineError
from embomatrix.world.asset import Asset, Link
from embomatrix.world.codec import asset_from_json, asset_to_json
from embomatrix.world.geometry import ConvexPart, Pose
from embomatrix.world.records import MAX_COORDINATE_M, UNIT_TOLERANCE, SceneInvalidError
from embomatrix.world.scene import Scene, SceneObject

WALLS_KEPT: Final = 1024
ASSETS_KEPT: Final = 512
"""Walls and assets that passed and are remembered: more than a scene has."""


def check_scene(scene: Scene) -> None:
    """Raise EngineError for the first element of the scene that physics can't take."""
    seen = {WALL, FLOOR, BACKGROUND}
    for wall in scene.walls:
        _check_wall(wall)
    for item in scene.objects:
        if item.name in seen:
            raise EngineError(f"two bodies are called {item.name!r}: expected unique names; rename one")
        seen.add(item.name)
        if item.asset_id not in scene.assets:
            raise EngineError(
                f"object {item.name!r} has the unknown asset {item.asset_id!r}: expected one of the scene's "
                f"{len(scene.assets)} assets; add it to the scene"
            )
        check_pose(item.pose_world_asset, item.name)
        check_fractions(item, scene.assets[item.asset_id], item.joints)
    for thing in scene.background:
        if thing.asset_id not in scene.assets:
            raise EngineError(
                f"a background object has the unknown asset {thing.asset_id!r}: expected one of the scene's "
                f"{len(scene.assets)} assets; add it to the scene"
            )
        check_pose(thing.pose_world_asset, thing.asset_id)
    for asset_id in sorted(
        {*(item.asset_id for item in scene.objects), *(thing.asset_id for thing in scene.background)}
    ):
        check_asset(scene.assets[asset_id])


@functools.lru_cache(maxsize=WALLS_KEPT)
def _check_wall(wall: ConvexPart) -> None:
    _check(Asset("wall", "wall", "", wall.size_m, 1.0, (Link("base", (wall,)),)))


def check_asset(asset: Asset) -> None:
    """Raise EngineError if physics can't hold the asset: its links and its mass must be valid in a bundle too.

    An asset that passed is not checked again: a layout loads nearly equal scenes hundreds of times.
    """
    if id(asset) in _SOUND:
        return
    _check(asset)
    if len(_SOUND) >= ASSETS_KEPT:
        _SOUND.clear()
    _SOUND[id(asset)] = asset


def _check(asset: Asset) -> None:
    try:
        asset_from_json(asset_to_json(replace(asset, supports=(), interiors=(), abilities={})))
    except SceneInvalidError as error:
        raise EngineError(f"physics can't hold asset {asset.asset_id!r}: {error}") from error


def check_again(assets: Iterable[Asset]) -> None:
    """Forget that these assets passed: their scene is closed, and nothing else may hold them."""
    for asset in assets:
        _SOUND.pop(id(asset), None)


_SOUND: Final[dict[int, Asset]] = {}
"""Assets that passed, by id. Holding the asset keeps its id from being reused."""


def check_pose(pose: Pose, what: str) -> None:
    """Raise EngineError unless the position is finite and within the world, and the quaternion has length 1."""
    x, y, z = pose.position_m
    limit = MAX_COORDINATE_M
    if not (-limit <= x <= limit and -limit <= y <= limit and -limit <= z <= limit):
        raise EngineError(
            f"{what!r} is at {pose.position_m} m: expected finite coordinates within {MAX_COORDINATE_M:.0f} m"
        )
    length = math.hypot(*pose.quat_xyzw)
    if not abs(length - 1.0) <= UNIT_TOLERANCE:
        raise EngineError(
            f"{what!r} has a quaternion of length {length}: expected 1; divide its four numbers by their norm"
        )


def check_fractions(item: SceneObject, asset: Asset, fractions: Sequence[float]) -> None:
    """Raise EngineError unless each joint of the asset has one number in 0..1."""
    if len(fractions) != len(asset.joints):
        raise EngineError(
            f"{item.name!r} has {len(fractions)} joint positions: expected {len(asset.joints)}, one for each joint of "
            f"{asset.asset_id!r}"
        )
    for value in fractions:
        if not 0.0 <= value <= 1.0:
            raise EngineError(
                f"{item.name!r} has a joint at {value}: expected a share of its travel from 0 to 1"
            )
