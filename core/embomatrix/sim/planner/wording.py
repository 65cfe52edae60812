"""Which of several objects an instruction means: plans that teach should do what the words say, where the goal is looser."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene
    from embomatrix.world.task import Task

NAMED: Final = 2
NAMED_IN_ROOM: Final = 3


class Wording:
    """How well an instruction names each object of the scene."""

    def __init__(self, task: Task, scene: Scene) -> None:
        self._scene = scene
        self._text = f" {_plain(task.instruction)} "
        self._room_types = {room.name: room.type for room in scene.rooms}

    def names(self, name: str) -> int:
        """0 when the instruction does not name the object's category, more when it does, most when in the right room."""
        item = self._scene.by_name.get(name)
        if item is None:
            return 0
        category = _plain(self._scene.assets[item.asset_id].category)
        room = _plain(self._room_types.get(item.room, ""))
        if room and f" {category} in the {room} " in self._text:
            return NAMED_IN_ROOM
        return NAMED if f" {category} " in self._text else 0


def _plain(text: str) -> str:
    """Lower-case words with single spaces."""
    return " ".join(re.findall(r"[a-z0-9]+", text.lower()))
