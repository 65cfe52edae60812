"""PNG pictures for vision-language models: a scene from above, the robot's view, and single rooms."""

import io
from dataclasses import replace
from typing import Final

from PIL import Image

from embomatrix.factory.pictures.scene import draw_plan
from embomatrix.factory.pictures.sheet import draw_eyes
from embomatrix.world.geometry import IDENTITY, Aabb
from embomatrix.world.scene import Room, Scene

WALL_M: Final = 0.3
"""Walls and openings within this distance of a room belong to it."""


def sights_of(scene: Scene) -> tuple[bytes, bytes]:
    """Return the labelled plan and the robot's view at its start in four directions. Raises EngineError without pybullet."""
    return _png(draw_plan(scene)), _png(draw_eyes(scene))


def sight_of_room(scene: Scene, room: str) -> bytes:
    """Return the labelled plan of one room. Raises KeyError for an unknown room."""
    return _png(draw_plan(alone(scene, room)))


def alone(scene: Scene, name: str) -> Scene:
    """Return the scene reduced to one room. Raises KeyError for an unknown room."""
    room = {each.name: each for each in scene.rooms}[name]
    return replace(
        scene,
        rooms=(room,),
        walls=tuple(wall for wall in scene.walls if _is_at(room, wall.aabb(IDENTITY))),
        doorways=tuple(door for door in scene.doorways if name in door.rooms),
        windows=tuple(window for window in scene.windows if name in window.rooms),
        objects=tuple(item for item in scene.objects if item.room == name),
        background=tuple(item for item in scene.background if item.room == name),
    )


def _is_at(room: Room, box: Aabb) -> bool:
    return all(
        box.low_m[axis] < room.high_m[axis] + WALL_M and box.high_m[axis] > room.low_m[axis] - WALL_M
        for axis in (0, 1)
    )


def _png(image: Image.Image) -> bytes:
    data = io.BytesIO()
    image.save(data, "PNG")
    return data.getvalue()
