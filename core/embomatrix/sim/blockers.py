"""Refusals that name the object in the way of the robot or its arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.engine import BACKGROUND, FLOOR, WALL
from embomatrix.sim.floor.obstacles import WALLS
from embomatrix.sim.geometry.surfaces import link_frame
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import PlaceRelation
from embomatrix.skills.view import SkillRefusal, preposition, refuse
from embomatrix.world.geometry import FloatArray, Vec2
from embomatrix.world.poses import Handling, StandPose
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.sim.floor.grid import FloorGrid
    from embomatrix.sim.live_world import LiveWorld

SAME_M: Final = 1e-6
RASTER_M: Final = 0.1
"""Spacing of the standing points that are tried."""
A_WALL: Final = "a wall"
_IN_WORDS: Final = {WALL: A_WALL, FLOOR: "the floor", BACKGROUND: "a background object", "": "something"}


def arm_refusal(world: LiveWorld, handling: Handling, target: str) -> SkillRefusal | None:
    """Refusal if the scene's analysis found no arm path for this action. It holds while the objects stay where they were."""
    other = world.arm_blockers.get(handling, {}).get(target, "")
    if not other or not _are_as_loaded(world, target, other):
        return None
    return refuse(FailureReason.ARM_BLOCKED, target=target, other=other)


def placing_refusal(world: LiveWorld, held: str, target: str, relation: Relation) -> SkillRefusal | None:
    """Refusal if the scene's analysis found no arm path to any pose on the target.

    It holds while the objects stay where they were.
    """
    other = world.placing_blockers.get(relation, {}).get(held, {}).get(target, "")
    if not other or not _are_as_loaded(world, target, other):
        return None
    return refuse(FailureReason.ARM_BLOCKED, target=f"a place for {held}", other=other)


def no_place_refusal(
    world: LiveWorld, held: str, target: str, relation: PlaceRelation, stands: Sequence[StandPose]
) -> SkillRefusal:
    """Refusal for an object without a free place at the target, from these standing poses. It names the object in the way."""
    reason, other = world.placer.hindrance(held, target, Relation(relation.value), stands)
    words = {"held": held, "target": target, "relation": preposition(relation)}
    return refuse(reason, other=obstacle_in_words(other), **words)


def obstacle_in_words(name: str) -> str:
    """Return an obstacle for a sentence: an object by its name, ``something`` for none."""
    return _IN_WORDS.get(name, name)


def _are_as_loaded(world: LiveWorld, *names: str) -> bool:
    return all(
        world.navigator.is_as_loaded(name) or _moved_with_drawer(world, name)
        for name in names
        if name in world.scene.by_name
    )


def _moved_with_drawer(world: LiveWorld, name: str) -> bool:
    """Return True if an object moved only with the drawer that it lies in: the analysis opened the drawer too."""
    if world.engine.is_parked(name):
        return False
    for enclosure in world.relations.enclosing(name)[:1]:
        asset, host = world.asset(enclosure.name), world.scene.by_name[enclosure.name]
        link = next(interior.link for interior in asset.interiors if interior.name == enclosure.interior)
        if link and world.navigator.is_as_loaded(enclosure.name):
            before = link_frame(asset, host.pose_world_asset, host.joints, link)
            now = link_frame(asset, host.pose_world_asset, world.engine.joints(host.name), link)
            moved = now @ before.inverse() @ world.scene.by_name[name].pose_world_asset
            return math.dist(moved.position_m, world.engine.pose(name).position_m) < SAME_M
    return False


def path_refusal(world: LiveWorld, target: str) -> SkillRefusal:
    """Refusal for an object without a reachable standing pose. It names the blocker."""
    room = world.room_of(target)
    area = world.navigator.standing_area(target)
    if room in world.rooms and world.navigator.room_entry(room, world.robot) is None:
        return refuse(FailureReason.NO_PATH, target=target, other=_between(world, room))
    window = area.window
    panel = _panel_in_the_way(world, lambda grid, label: bool(area.stands(grid.free_centers(*window, label))))
    if panel:
        return refuse(FailureReason.NO_STANDING_POSE, target=target, other=panel)
    points = area.serving(_on_floor(world, _raster(*window)))
    other = _main_blocker(world, points)
    return refuse(FailureReason.NO_STANDING_POSE, target=target, other=other)


def room_refusal(world: LiveWorld, room: str) -> SkillRefusal:
    """Refusal for a room that no path leads to. It names the blocker."""
    return refuse(FailureReason.NO_PATH, target=room, other=_between(world, room))


def _panel_in_the_way(world: LiveWorld, suffices: Callable[[FloorGrid, int], bool]) -> str:
    """First object whose doors and drawers alone block the robot; "" for none.

    ``suffices`` returns True if a component of a grid, given by its number, is good enough.
    """
    ground = world.navigator.ground
    for owner in dict.fromkeys(ground.open_panels.owners.tolist()):
        grid = ground.with_shut(owner)
        start = grid.cell(world.robot.x_m, world.robot.y_m)
        if start is not None and suffices(grid, grid.label(start)):
            return str(world.scene.objects[owner].name)
    return ""


def _between(world: LiveWorld, room: str) -> str:
    """Object on the cheapest path into a room that the robot can't drive through."""
    area = next(item for item in world.scene.rooms if item.name == room)
    panel = _panel_in_the_way(
        world, lambda grid, label: bool(len(grid.free_centers(area.low_m, area.high_m, label)))
    )
    if panel:
        return panel
    crossed = world.navigator.crossing(world.robot, area.low_m, area.high_m)
    return _main_blocker(world, crossed)


def _main_blocker(world: LiveWorld, points: FloatArray) -> str:
    """Object that blocks the most points; a wall if no object blocks any."""
    obstacles = world.navigator.ground.obstacles
    counts = obstacles.owners_near(points) if len(points) else {}
    counts.pop(WALLS, None)
    # Ties go to the first in scene order: the answer is part of the trace.
    number = max(sorted(counts), key=lambda owner: counts[owner], default=WALLS)
    return world.scene.objects[number].name if counts.get(number) else A_WALL


def _raster(low: Vec2, high: Vec2) -> FloatArray:
    """Grid of points over a rectangle, shape (n, 2)."""
    x, y = (np.arange(a, b, RASTER_M) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _on_floor(world: LiveWorld, points: FloatArray) -> FloatArray:
    """Points that lie in a room."""
    inside = np.zeros(len(points), dtype=np.bool_)
    for room in world.scene.rooms:
        inside |= ((points >= room.low_m) & (points <= room.high_m)).all(axis=1)
    return np.asarray(points[inside], dtype=np.float64)
