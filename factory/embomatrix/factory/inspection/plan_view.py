"""The plan view of a scene as SVG, north up, with a mark for the robot and one for each small thing of a task."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.pictures.scene import footprint, is_overhead
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    from collections.abc import Collection

    from embomatrix.world.geometry import Aabb
    from embomatrix.world.scene import Scene

_ORIGIN: Final = Pose((0.0, 0.0, 0.0))
_MARGIN_M: Final = 0.4
UNIT: Final = 100
"""Units of the picture in a metre: whole numbers keep the file small."""
ROBOT_M: Final = 0.25
DOT_M: Final = 0.1


class PlanView:
    """Places of the world in the picture, and the picture. ``rooms`` are those to be shown; all others are left out."""

    def __init__(self, scene: Scene, rooms: Collection[str]) -> None:
        self._scene = scene
        self._rooms = [room for room in scene.rooms if room.name in rooms] or list(scene.rooms)
        self._low = np.min([room.low_m for room in self._rooms], axis=0) - _MARGIN_M
        self._high = np.max([room.high_m for room in self._rooms], axis=0) + _MARGIN_M

    def at(self, x_m: float, y_m: float) -> tuple[int, int]:
        """A point of the world in the picture's units."""
        return round((x_m - self._low[0]) * UNIT), round((self._high[1] - y_m) * UNIT)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in the picture's units."""
        width, height = (self._high - self._low) * UNIT
        return round(float(width)), round(float(height))

    def svg(self, about: Collection[str], things: Collection[str]) -> str:
        """The picture. ``about`` are objects that the goal is about, ``things`` small ones that get a mark by their name."""
        width, height = self.size
        names = {room.name for room in self._rooms}
        parts = [f'<svg id="plan" viewBox="0 0 {width} {height}" role="img" aria-label="plan of the scene">']
        parts += [self._box(room.low_m, room.high_m, "room") for room in self._rooms]
        for wall in self._scene.walls:
            around = wall.aabb(_ORIGIN)
            if around.low_m[2] < 0.1 and self._is_seen(around):
                parts.append(self._box(around.low_m[:2], around.high_m[:2], "wall"))
        for item in self._scene.objects:
            around = footprint(self._scene, item)
            if item.room in names and item.name not in things and not is_overhead(around) and not item.absent:
                kind = "piece goal" if item.name in about else "piece"
                parts.append(self._box(around.low_m[:2], around.high_m[:2], kind, item.name))
        parts += [self._label(room.low_m[0], room.high_m[1], room.name) for room in self._rooms]
        parts.append('<polyline id="way" points=""/>')
        r = round(ROBOT_M * UNIT)
        parts.append(
            f'<g id="robot"><circle r="{r}"/><path d="M {r} 0 L {r // 3} {r // 2} L {r // 3} {-r // 2} Z"/>'
            "<title>robot</title></g>"
        )
        parts += [
            f'<circle class="thing{" goal" if name in about else ""}" data-name="{escape(name)}" r="{round(DOT_M * UNIT)}">'
            f"<title>{escape(name)}</title></circle>"
            for name in things
        ]
        return "".join(parts) + "</svg>"

    def _is_seen(self, box: Aabb) -> bool:
        return bool(np.all(box.low_m[:2] < self._high) and np.all(box.high_m[:2] > self._low))

    def _box(self, low_m: tuple[float, ...], high_m: tuple[float, ...], kind: str, title: str = "") -> str:
        (left, bottom), (right, top) = self.at(*low_m[:2]), self.at(*high_m[:2])
        shape = f'<rect class="{kind}" x="{left}" y="{top}" width="{max(2, right - left)}" height="{max(2, bottom - top)}"'
        return (
            f'{shape} data-name="{escape(title)}"><title>{escape(title)}</title></rect>'
            if title
            else f"{shape}/>"
        )

    def _label(self, x_m: float, y_m: float, words: str) -> str:
        x, y = self.at(x_m, y_m)
        return f'<text x="{x + 12}" y="{y + 34}">{escape(words.replace("_", " "))}</text>'
