"""Top-down picture of a scene: rooms, walls, doorways, furniture with its front, small things as numbered dots."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Aabb, Pose

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene, SceneObject

_ORIGIN: Final = Pose((0.0, 0.0, 0.0))
_MARGIN_PX: Final = 30
_LONG_SIDE_PX: Final = 1500
_LINE_PX: Final = 15
_COLUMN_PX: Final = 330
_PANE_M: Final = 0.03
"""Half the thickness at which windows are drawn."""
_SMALL_M: Final = 0.3
_HUNG_M: Final = 1.2
_CEILING_M: Final = 2.3
PALE: Final = ("#f6f1e7", "#eaf1f6", "#f1eaf4", "#e9f4ea", "#f7ecec", "#f3f3e4", "#e8f3f3")
FILL: Final = {
    "opens": "#f0c48a",
    "works": "#9fc5e8",
    "rests": "#d9d2c5",
    "hung": "#c9b8e0",
    "rug": "#e4d3d3",
    "plant": "#bcd9a9",
}
_LEGEND: Final = (
    ("opens", "opens (cabinet, fridge, oven ...)"),
    ("works", "switches on, gives water or heat"),
    ("rests", "other furniture"),
    ("hung", "on the wall above the robot's way"),
    ("rug", "rug"),
    ("plant", "plant"),
)
_SIGNS: Final = ("triangle: front · red: doorway", "blue: window · ring: light or fan")
_PLANTS: Final = frozenset({"tree", "low_resolution_tree", "bush", "pot_plant"})
_WORKS: Final = ("toggleable", "heatSource", "coldSource", "particleSource")


def draw_plan(scene: Scene) -> Image.Image:
    """The scene from above, north up, with a legend of everything small on the right. Returns an RGB image."""
    picture = _Plan(scene)
    picture.rooms()
    picture.walls()
    picture.furniture()
    picture.small_things()
    picture.robot()
    return picture.image


def footprint(scene: Scene, item: SceneObject) -> Aabb:
    """Bounding box of an object in the world, closed."""
    return scene.box_of(item.name)


def is_overhead(box: Aabb) -> bool:
    """Whether an object with this box hangs under the ceiling, out of the plan's way."""
    return box.high_m[2] > _CEILING_M and box.low_m[2] > 0.85


def kind_of(scene: Scene, item: SceneObject, box: Aabb) -> str:
    """Key of ``FILL``: what an object is to the robot."""
    asset = scene.assets[item.asset_id]
    if box.low_m[2] >= _HUNG_M:
        return "hung"
    if box.high_m[2] < 0.04:
        return "rug"
    if asset.category in _PLANTS:
        return "plant"
    if asset.can("openable"):
        return "opens"
    return "works" if any(asset.can(a) for a in _WORKS) else "rests"


class _Plan:
    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        low = np.min([r.low_m for r in scene.rooms], axis=0) - 0.3
        high = np.max([r.high_m for r in scene.rooms], axis=0) + 0.3
        self._low, self._high = low, high
        self._scale = min(110.0, _LONG_SIDE_PX / float(max(high - low)))
        width, height = ((high - low) * self._scale).astype(int)
        self._small = [o for o in scene.objects if self._is_small(o)]
        self._legend_x = int(width) + _MARGIN_PX
        rows = len(self._small) + len(_LEGEND) + len(_SIGNS) + 5
        columns = max(1, math.ceil(rows * _LINE_PX / max(int(height), 700)))
        size = (self._legend_x + columns * _COLUMN_PX, max(int(height), 700) + 2 * _MARGIN_PX)
        self.image = Image.new("RGB", size, "white")
        self._draw = ImageDraw.Draw(self.image)
        self._row = 0

    def rooms(self) -> None:
        for number, room in enumerate(self._scene.rooms):
            corners = [self._px(*room.low_m), self._px(*room.high_m)]
            self._draw.rectangle(_ordered(corners), fill=PALE[number % len(PALE)])
        # Names last, at the top left of each room, where furniture seldom hides them.

    def walls(self) -> None:
        for part in self._scene.walls:
            box = part.aabb(_ORIGIN)
            thin = min(part.size_m[:2]) < 0.1
            if box.low_m[2] > 0.1:
                continue
            corners = [self._px(*box.low_m[:2]), self._px(*box.high_m[:2])]
            self._draw.rectangle(_ordered(corners), fill="#b5522b" if thin else "#3a3a3a")
        for door in self._scene.doorways:
            a, b = (door.width_m / 2, 0.0) if door.along == "x" else (0.0, door.width_m / 2)
            x, y = door.center_m
            ends = [self._px(x - a, y - b), self._px(x + a, y + b)]
            self._draw.line(ends, fill="#b5522b", width=2)
        for window in self._scene.windows:
            a, b = (window.width_m / 2, _PANE_M) if window.along == "x" else (_PANE_M, window.width_m / 2)
            x, y = window.center_m
            corners = [self._px(x - a, y - b), self._px(x + a, y + b)]
            self._draw.rectangle(_ordered(corners), fill="#6fc3e8")

    def furniture(self) -> None:
        shown = [o for o in self._scene.objects if not self._is_small(o)]
        for item in sorted(shown, key=lambda o: footprint(self._scene, o).low_m[2]):
            box = footprint(self._scene, item)
            if is_overhead(box):
                self._ceiling(box)
                continue
            kind = kind_of(self._scene, item, box)
            outline = "#7a5fa8" if kind == "hung" else "#555555"
            corners = _ordered([self._px(*box.low_m[:2]), self._px(*box.high_m[:2])])
            self._draw.rectangle(
                corners, fill=None if kind == "hung" else FILL[kind], outline=outline, width=2
            )
            self._front(item, outline)
            self._label(item.name, corners, "#5a3f88" if kind == "hung" else "black")
        for room in self._scene.rooms:
            x, y = self._px(room.low_m[0] + 0.08, room.high_m[1] - 0.06)
            self._text((x, y), f"{room.name}  {room.size_m[0]:.1f} x {room.size_m[1]:.1f} m", 13, "#b03030")

    def small_things(self) -> None:
        self._say("Legend", 15)
        for kind, words in _LEGEND:
            x, y = self._place()
            self._draw.rectangle((x, y + 2, x + 14, y + 12), fill=FILL[kind], outline="#555555")
            self._text((x + 22, y), words, 11, "black")
            self._row += 1
        for signs in _SIGNS:
            self._say(f"      {signs}")
        self._say("")
        for number, item in enumerate(self._small, start=1):
            x, y = self._px(*item.pose_world_asset.position_m[:2])
            color = "#1b7f3b" if not item.fixed else "#204a87"
            self._draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=color)
            self._text((x + 3, y - 9), str(number), 9, color)
            z = footprint(self._scene, item).low_m[2]
            where = (
                f"{item.relation.value} {item.host}"
                if item.relation and item.host
                else "on the wall"
                if z > 0.05
                else "on the floor"
            )
            self._say(f"{number:>3} {item.name}  {where}")

    def robot(self) -> None:
        start = self._scene.robot
        x, y = self._px(start.x_m, start.y_m)
        r = ROBOT.radius_m * self._scale
        self._draw.ellipse((x - r, y - r, x + r, y + r), outline="#d02020", width=2)
        tip = (x + r * math.cos(start.yaw), y - r * math.sin(start.yaw))
        self._draw.line((x, y, *tip), fill="#d02020", width=2)
        self._text((x - r, y + r), "robot", 11, "#d02020")

    def _is_small(self, item: SceneObject) -> bool:
        box = footprint(self._scene, item)
        x, y, _ = box.size_m
        return (max(x, y) < _SMALL_M or bool(item.host and not item.fixed)) and not is_overhead(box)

    def _ceiling(self, box: Aabb) -> None:
        x, y = self._px(*box.center_m[:2])
        self._draw.ellipse((x - 6, y - 6, x + 6, y + 6), outline="#c9a227", width=2)

    def _front(self, item: SceneObject, color: str) -> None:
        """A triangle at the middle of the front edge, pointing to the room."""
        size = self._scene.assets[item.asset_id].size_m
        pose = item.pose_world_asset
        if abs(pose.rotation[2, 2]) < 0.9:
            return
        tip = pose.apply((size[0] / 2, 0.0, 0.0))
        base = max(0.0, size[0] / 2 - 0.09)
        left, right = pose.apply((base, 0.06, 0.0)), pose.apply((base, -0.06, 0.0))
        self._draw.polygon([self._px(*p[:2]) for p in (tip, left, right)], fill=color)

    def _label(self, name: str, box: tuple[int, int, int, int], color: str) -> None:
        """The name inside the box, along its longer side, as large as it fits between 8 and 12 points."""
        width, height = box[2] - box[0], box[3] - box[1]
        upright = height > 1.4 * width
        room = max(width, height) if upright else width
        size = int(min(12, max(8, room / max(1, len(name)) * 1.9)))
        font = ImageFont.load_default(size)
        _left, _top, right, bottom = font.getbbox(name)
        tag = Image.new("L", (int(right) + 2, int(bottom) + 2), 0)
        ImageDraw.Draw(tag).text((1, 1), name, fill=255, font=font)
        if upright:
            tag = tag.rotate(90, expand=True)
        x, y = (box[0] + box[2] - tag.width) // 2, (box[1] + box[3] - tag.height) // 2
        self.image.paste(color, (int(x), int(y)), tag)

    def _say(self, line: str, size: int = 11) -> None:
        self._text(self._place(), line, size, "black")
        self._row += 1

    def _place(self) -> tuple[int, int]:
        rows = (self.image.height - 2 * _MARGIN_PX) // _LINE_PX
        return (self._legend_x + _COLUMN_PX * (self._row // rows), _MARGIN_PX + _LINE_PX * (self._row % rows))

    def _text(self, at: tuple[float, float], words: str, size: int, color: str) -> None:
        self._draw.text(at, words, fill=color, font=ImageFont.load_default(size))

    def _px(self, x: float, y: float) -> tuple[int, int]:
        return (
            int(_MARGIN_PX / 2 + (x - self._low[0]) * self._scale),
            int(_MARGIN_PX / 2 + (self._high[1] - y) * self._scale),
        )


def _ordered(corners: list[tuple[int, int]]) -> tuple[int, int, int, int]:
    (a, b), (c, d) = corners
    return (min(a, c), min(b, d), max(a, c), max(b, d))
