"""Who bars the robot's way, by name: what a person would move to let it pass."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.floor.obstacles import WALLS
from embomatrix.sim.geometry.surfaces import link_frame
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import refuse

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.sim.floor.grid import FloorGrid
    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.skills.view import SkillRefusal
    from embomatrix.world.geometry import FloatArray, Vec2
    from embomatrix.world.poses import Handling
    from embomatrix.world.state import Relation

SAME_M: Final = 1e-6
RASTER_M: Final = 0.1
"""Distance of the points at which the robot might stand."""
WALL: Final = "a wall"


def no_way_for_arm(world: LiveWorld, handling: Handling, target: str) -> SkillRefusal | None:
    """Refusal when the scene's analysis found no way of the arm to do this; while all stays where it was."""
    other = world.barred.get(handling, {}).get(target, "")
    if not other or not _are_as_loaded(world, target, other):
        return None
    return refuse(FailureReason.ARM_BLOCKED, target=target, other=other)


def no_way_to_place(world: LiveWorld, held: str, target: str, relation: Relation) -> SkillRefusal | None:
    """Refusal when the scene's analysis found that the arm gets nowhere with this there; while all stays where it was."""
    other = world.barred_places.get(relation, {}).get(held, {}).get(target, "")
    if not other or not _are_as_loaded(world, target, other):
        return None
    return refuse(FailureReason.ARM_BLOCKED, target=f"a place for {held}", other=other)


def _are_as_loaded(world: LiveWorld, *names: str) -> bool:
    return all(
        world.navigator.is_as_loaded(name) or _is_led_out(world, name)
        for name in names
        if name in world.scene.by_name
    )


def _is_led_out(world: LiveWorld, name: str) -> bool:
    """Whether an object moved only as the drawer did that it lies in: the arm was looked for with that led out."""
    if world.engine.is_parked(name):
        return False
    for enclosure in world.relations.enclosing(name)[:1]:
        asset, host = world.asset(enclosure.name), world.scene.by_name[enclosure.name]
        link = next(interior.link for interior in asset.interiors if interior.name == enclosure.interior)
        if link and world.navigator.is_as_loaded(enclosure.name):
            before = link_frame(asset, host.pose_world_asset, host.joints, link)
            now = link_frame(asset, host.pose_world_asset, world.engine.joints(host.name), link)
            led = now @ before.inverse() @ world.scene.by_name[name].pose_world_asset
            return math.dist(led.position_m, world.engine.pose(name).position_m) < SAME_M
    return False


def no_way_to(world: LiveWorld, target: str) -> SkillRefusal:
    """Why the robot does not get to an object that it has no standing pose for, and who is in the way."""
    room = world.room_of(target)
    service = world.navigator.service(target)
    if room in world.rooms and world.navigator.room_entry(room, world.robot) is None:
        return refuse(FailureReason.NO_PATH, target=target, other=_between(world, room))
    window = service.window
    leaf = _leaf_in_the_way(
        world, lambda grid, label: bool(service.stands(grid.free_centers(*window, label)))
    )
    if leaf:
        return refuse(FailureReason.NO_STANDING_POSE, target=target, other=leaf)
    points = service.serving(_on_floor(world, _raster(*window)))
    other = _most_in_the_way(world, points)
    return refuse(FailureReason.NO_STANDING_POSE, target=target, other=other)


def no_way_into(world: LiveWorld, room: str) -> SkillRefusal:
    """Why the robot does not get into a room that no path leads to, and who is in the way."""
    return refuse(FailureReason.NO_PATH, target=room, other=_between(world, room))


def _leaf_in_the_way(world: LiveWorld, leads: Callable[[FloorGrid, int], bool]) -> str:
    """The first object that would let the robot pass if its doors and drawers alone were shut; "" when there is none.

    ``leads`` says of a grid whether the component of this number will do.
    """
    ground = world.navigator.ground
    for owner in dict.fromkeys(ground.leaves.owners.tolist()):
        grid = ground.with_shut(owner)
        start = grid.cell(world.robot.x_m, world.robot.y_m)
        if start is not None and leads(grid, grid.label(start)):
            return str(world.scene.objects[owner].name)
    return ""


def _between(world: LiveWorld, room: str) -> str:
    """What the robot would have to drive through on the way to a room that costs the least."""
    area = next(item for item in world.scene.rooms if item.name == room)
    leaf = _leaf_in_the_way(
        world, lambda grid, label: bool(len(grid.free_centers(area.low_m, area.high_m, label)))
    )
    if leaf:
        return leaf
    crossed = world.navigator.crossing(world.robot, area.low_m, area.high_m)
    return _most_in_the_way(world, crossed)


def _most_in_the_way(world: LiveWorld, points: FloatArray) -> str:
    """The object that keeps the robot from the most of some points; a wall when none does."""
    obstacles = world.navigator.ground.obstacles
    counts = obstacles.owners_near(points) if len(points) else {}
    counts.pop(WALLS, None)
    # Of equals the first in scene order: the answer is part of the trace.
    number = max(sorted(counts), key=lambda owner: counts[owner], default=WALLS)
    return world.scene.objects[number].name if counts.get(number) else WALL


def _raster(low: Vec2, high: Vec2) -> FloatArray:
    """Points of a rectangle, shape (n, 2)."""
    x, y = (np.arange(a, b, RASTER_M) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _on_floor(world: LiveWorld, points: FloatArray) -> FloatArray:
    """Those of some points that lie in a room."""
    inside = np.zeros(len(points), dtype=np.bool_)
    for room in world.scene.rooms:
        inside |= ((points >= room.low_m) & (points <= room.high_m)).all(axis=1)
    return np.asarray(points[inside], dtype=np.float64)
