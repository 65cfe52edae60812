"""Checks of a scene before physics loads it: Bullet silently accepts NaN, unknown ids and a 17th part."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.engine import FLOOR, WALL, EngineError
from embomatrix.world.geometry import Shape
from embomatrix.world.records import MAX_VERTICES
from embomatrix.world.tables import has_volume

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from embomatrix.world.asset import Asset, Joint, Link
    from embomatrix.world.geometry import ConvexPart, Pose
    from embomatrix.world.scene import Scene, SceneObject

PART_LIMIT: Final = 16
LINK_LIMIT: Final = 100
MIN_EXTENT_M: Final = 0.001
WORLD_LIMIT_M: Final = 1e4
UNIT_TOLERANCE: Final = 1e-4


def check_scene(scene: Scene) -> None:
    """Raise EngineError for the first element of the scene that physics can't take."""
    seen = {WALL, FLOOR}
    for wall in scene.walls:
        _check_part(wall, f"a wall of scene {scene.scene_id!r}")
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
    for asset_id in sorted({item.asset_id for item in scene.objects}):
        check_asset(scene.assets[asset_id])


def check_asset(asset: Asset) -> None:
    """Raise EngineError if physics can't hold the asset."""
    what = f"asset {asset.asset_id!r}"
    pieces = sum(1 + sum(part.shape is Shape.HULL for part in link.parts) for link in asset.links)
    if not asset.links or not asset.links[0].parts or asset.links[0].joint is not None:
        raise EngineError(f"{what} has no base: expected a first link with parts and without a joint")
    if pieces > LINK_LIMIT:
        raise EngineError(
            f"{what} makes {pieces} bodies: expected at most {LINK_LIMIT}; use fewer hulls or links"
        )
    if not (math.isfinite(asset.mass_kg) and asset.mass_kg > 0):
        raise EngineError(f"{what} weighs {asset.mass_kg} kg: expected a positive, finite mass")
    for number, link in enumerate(asset.links):
        _check_link(link, what, moves=number > 0)


def check_pose(pose: Pose, what: str) -> None:
    """Raise EngineError unless the position is finite and within the world, and the quaternion has length 1."""
    x, y, z = pose.position_m
    limit = WORLD_LIMIT_M
    if not (-limit <= x <= limit and -limit <= y <= limit and -limit <= z <= limit):
        raise EngineError(
            f"{what!r} is at {pose.position_m} m: expected finite coordinates within {WORLD_LIMIT_M:.0f} m"
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


def _check_link(link: Link, what: str, *, moves: bool) -> None:
    plain = sum(part.shape is not Shape.HULL for part in link.parts)
    if plain > PART_LIMIT:
        raise EngineError(
            f"link {link.name!r} of {what} has {plain} parts: expected at most {PART_LIMIT}; merge some or split the link"
        )
    if moves and link.joint is None:
        raise EngineError(
            f"link {link.name!r} of {what} has no joint: expected one on each link after the base"
        )
    if link.joint is not None:
        _check_joint(link.joint, f"link {link.name!r} of {what}")
    for part in link.parts:
        _check_part(part, f"a part of {what}")


def _check_joint(joint: Joint, what: str) -> None:
    if not _finite((*joint.origin_m, joint.upper)) or joint.upper == 0.0:
        raise EngineError(
            f"{what} has a joint with travel {joint.upper}: expected a finite number other than 0"
        )
    if not abs(math.hypot(*joint.axis) - 1.0) <= UNIT_TOLERANCE:
        raise EngineError(f"{what} has the joint axis {joint.axis}: expected a vector of length 1")


def _check_part(part: ConvexPart, what: str) -> None:
    check_pose(part.pose, what)
    if not all(MIN_EXTENT_M <= extent <= WORLD_LIMIT_M for extent in part.size_m):
        raise EngineError(
            f"{what} measures {part.size_m} m: expected extents of {MIN_EXTENT_M} m or more; make it thicker or leave it out"
        )
    if part.shape is not Shape.HULL:
        return
    if len(part.vertices_m) < 4 or not all(_finite(vertex) for vertex in part.vertices_m):
        raise EngineError(
            f"{what} is a hull of {len(part.vertices_m)} vertices: expected 4 or more finite points"
        )
    if len(part.vertices_m) > MAX_VERTICES or not has_volume(np.asarray(part.vertices_m)):
        raise EngineError(
            f"{what} is a hull of {len(part.vertices_m)} vertices, flat or too many: expected at most {MAX_VERTICES} that "
            "span a body"
        )


def _finite(values: Iterable[float]) -> bool:
    return all(map(math.isfinite, values))
