"""Plan of a scene from above: rooms, walls, doorways, furniture with its front, small objects as dots."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageOps

from embomatrix.factory.pictures.labels import GAP, Box, Labels, boxes
from embomatrix.factory.pictures.legend import counted, draw_legend, in_order
from embomatrix.factory.scenes.view import SceneView
from embomatrix.sim.geometry.door_leaves import door_leaves
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import IDENTITY, Aabb
from embomatrix.world.scene import Scene, SceneObject

_MARGIN_PX: Final = 15
_FINEST_PX_PER_M: Final = 110.0
_LONG_SIDE_PX: Final = 1500
_COARSEST_PX_PER_M: Final = 60.0
"""Least scale at which names fit into rooms and furniture: large scenes get a larger picture."""
_LONGEST_SIDE_PX: Final = 3000
"""Upper limit for the picture's long side."""
_LEAST_HEIGHT_PX: Final = 700
_EACH_BY_NUMBER: Final = 3
"""Up to this many small objects on a host get numbers; more share one line of the legend."""
_PANE_M: Final = 0.03
"""Half the drawn thickness of windows."""
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
    "background": "#c9c4ba",
}
_LEGEND: Final = (
    ("opens", "opens (cabinet, fridge, oven ...)"),
    ("works", "switches on, gives water or heat"),
    ("rests", "other furniture"),
    ("hung", "on the wall, above the robot"),
    ("rug", "rug"),
    ("plant", "plant"),
    ("background", "background object without a name"),
)
_SIGNS: Final = (
    "triangle: front · red: doorway with its open door · blue: window",
    "ring: light or fan · dot: small object, green if it can move",
)
_ROOM_COLOR: Final = "#b03030"
_PLANTS: Final = frozenset({"tree", "low_resolution_tree", "bush", "pot_plant"})
_WORKS: Final = ("toggleable", "heatSource", "coldSource", "particleSource")


def draw_plan(scene: Scene) -> Image.Image:
    """Return an RGB image of the scene from above, north up, with a legend for names that do not fit."""
    plan = _Plan(scene)
    plan.building()
    plan.furniture()
    plan.background()
    plan.small_things()
    plan.robot()
    lines = plan.label()
    height = max(plan.image.height, _LEAST_HEIGHT_PX)
    legend = draw_legend([(FILL[kind], words) for kind, words in _LEGEND], [*_SIGNS, "", *lines], height)
    whole = Image.new("RGB", (plan.image.width + legend.width, height), "white")
    whole.paste(plan.image, (0, 0))
    whole.paste(legend, (plan.image.width, 0))
    return whole


def draw_thumbnail(scene: Scene, side_px: int) -> Image.Image:
    """Return rooms, walls, openings and furniture from above without text, fitted into a square."""
    plan = _Plan(scene)
    plan.building()
    plan.furniture()
    return ImageOps.pad(plan.image, (side_px, side_px), color="white")


def is_overhead(box: Aabb) -> bool:
    """True if an object with this box hangs under the ceiling."""
    return box.high_m[2] > _CEILING_M and box.low_m[2] > 0.85


def kind_of(scene: Scene, item: SceneObject, box: Aabb) -> str:
    """Return the key of ``FILL`` for an object."""
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
        self._view = SceneView(scene)
        self._low = np.min([r.low_m for r in scene.rooms], axis=0) - 0.3
        self._high = np.max([r.high_m for r in scene.rooms], axis=0) + 0.3
        extent = self._high - self._low
        longest = float(max(extent))
        self._scale = min(
            _FINEST_PX_PER_M,
            max(_LONG_SIDE_PX / longest, min(_COARSEST_PX_PER_M, _LONGEST_SIDE_PX / longest)),
        )
        width, height = (int(side * self._scale) + 2 * _MARGIN_PX for side in extent)
        self.image = Image.new("RGB", (width, height), "white")
        self._draw = ImageDraw.Draw(self.image)
        self._small = [o for o in scene.objects if self._is_small(o)]
        self._named: list[tuple[SceneObject, Box, str]] = []
        """Furniture with the box for its name and the text colour."""
        self._marks: list[Box] = []
        """Boxes that text avoids if possible: dots, fronts, lights, the robot."""

    def building(self) -> None:
        for number, room in enumerate(self._scene.rooms):
            self._draw.rectangle(self._box(room.low_m, room.high_m), fill=PALE[number % len(PALE)])
        for wall in (*self._scene.walls, *door_leaves(self._scene)):
            around = wall.aabb(IDENTITY)
            if around.low_m[2] <= 0.1:
                fill = "#b5522b" if min(wall.size_m[:2]) < 0.1 else "#3a3a3a"
                # In the plan of a single room, walls are clipped to the room.
                low, high = np.clip([around.low_m[:2], around.high_m[:2]], self._low, self._high)
                self._draw.rectangle(self._box(low, high), fill=fill)
        for window in self._scene.windows:
            a, b = (window.width_m / 2, _PANE_M) if window.along == "x" else (_PANE_M, window.width_m / 2)
            x, y = window.center_m
            self._draw.rectangle(self._box((x - a, y - b), (x + a, y + b)), fill="#6fc3e8")
        for door in self._scene.doorways:
            a, b = (door.width_m / 2, 0.0) if door.along == "x" else (0.0, door.width_m / 2)
            x, y = door.center_m
            ends = [self._px(x - a, y - b), self._px(x + a, y + b)]
            self._draw.line(ends, fill="#b5522b", width=2)

    def furniture(self) -> None:
        shown = [o for o in self._scene.objects if not self._is_small(o)]
        for item in sorted(shown, key=self._layer):
            box = self._scene.box_of(item.name)
            if is_overhead(box):
                self._ceiling(box)
                continue
            kind = kind_of(self._scene, item, box)
            outline = "#7a5fa8" if kind == "hung" else "#555555"
            corners = self._box(box.low_m, box.high_m)
            self._draw.rectangle(
                corners, fill=None if kind == "hung" else FILL[kind], outline=outline, width=2
            )
            self._front(item, outline)
            self._named.append((item, corners, "#5a3f88" if kind == "hung" else "black"))

    def small_things(self) -> None:
        for item in self._small:
            x, y = self._px(*item.pose_world_asset.position_m[:2])
            self._draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=_dot_color(item))
            self._marks.append((x - 3, y - 3, x + 3, y + 3))

    def background(self) -> None:
        """Draw the footprints of background objects."""
        for box in self._scene.background_boxes:
            self._draw.rectangle(self._box(box.low_m, box.high_m), fill=FILL["background"], outline="#8d877c")

    def robot(self) -> None:
        start = self._scene.robot
        x, y = self._px(start.x_m, start.y_m)
        r = ROBOT.radius_m * self._scale
        around = (int(x - r), int(y - r), int(x + r), int(y + r))
        self._draw.ellipse(around, outline="#d02020", width=2)
        self._marks.append(around)
        tip = (x + r * math.cos(start.yaw), y - r * math.sin(start.yaw))
        self._draw.line((x, y, *tip), fill="#d02020", width=2)

    def label(self) -> list[str]:
        """Write names if they fit, else numbers; return the legend's lines."""
        labels = Labels(self.image)
        self._label_rooms(labels)
        marks = boxes(self._marks)
        numbered: list[tuple[SceneObject, Box, str]] = []
        # Objects on furniture come first because they cover it; then small boxes, which have fewer places for text.
        for item, box, color in sorted(self._named, key=lambda named: (not named[0].host, _area(named[1]))):
            if not labels.inside(item.name, box, color, marks):
                numbered.append((item, box, color))
        names_by_host = self._names_by_host()
        hidden = {name for names in names_by_host.values() for name in names}
        for item in self._small:
            if item.name not in hidden:
                x, y = self._px(*item.pose_world_asset.position_m[:2])
                numbered.append((item, (x, y, x, y), _dot_color(item)))
        lines = []
        for number, (item, box, color) in enumerate(sorted(numbered, key=lambda n: in_order(n[0].name)), 1):
            if not labels.inside(str(number), box, color, marks):
                labels.beside(str(number), _middle(box), color, marks)
            lines.append(f"{number}  {item.name}  {self._where(item)}".rstrip())
        groups = [f"{where}: {counted(names)}" for where, names in sorted(names_by_host.items())]
        return [*lines, *([""] if groups else []), *groups]

    def _label_rooms(self, labels: Labels) -> None:
        standing = boxes([*(box for _, box, _ in self._named), *self._marks])
        for room in self._scene.rooms:
            box = self._box(room.low_m, room.high_m)
            size = f"{room.size_m[0]:.1f} x {room.size_m[1]:.1f} m"
            if not any(
                labels.inside(words, box, _ROOM_COLOR, standing)
                for words in (f"{room.name}{GAP}{size}", room.name)
            ):
                labels.beside(room.name, _middle(box), _ROOM_COLOR, standing)
        x, y = self._px(self._scene.robot.x_m, self._scene.robot.y_m)
        labels.beside("robot", (x, y + int(ROBOT.radius_m * self._scale)), "#d02020", standing)

    def _names_by_host(self) -> Mapping[str, Sequence[str]]:
        """Group small objects by place, as ``inside shelf_1``, if there are too many for numbers."""
        names_by_host = defaultdict(list)
        for item in self._small:
            if item.relation and item.host:
                names_by_host[self._where(item)].append(item.name)
        return {where: names for where, names in names_by_host.items() if len(names) > _EACH_BY_NUMBER}

    def _where(self, item: SceneObject) -> str:
        is_told = (item.relation and item.host) or self._is_small(item)
        return self._view.whereabouts(item.name) if is_told else ""

    def _is_small(self, item: SceneObject) -> bool:
        box = self._scene.box_of(item.name)
        x, y, _ = box.size_m
        return (max(x, y) < _SMALL_M or bool(item.host and not item.fixed)) and not is_overhead(box)

    def _layer(self, item: SceneObject) -> tuple[int, float]:
        """Return the drawing order: rugs, then plants, whose crowns would hide furniture, then by height."""
        box = self._scene.box_of(item.name)
        kind = kind_of(self._scene, item, box)
        rank = 2 if item.host else {"rug": 0, "plant": 1}.get(kind, 2)
        return rank, box.low_m[2]

    def _ceiling(self, box: Aabb) -> None:
        x, y = self._px(*box.center_m[:2])
        around = (x - 6, y - 6, x + 6, y + 6)
        self._draw.ellipse(around, outline="#c9a227", width=2)
        self._marks.append(around)

    def _front(self, item: SceneObject, color: str) -> None:
        """Draw a triangle at the centre of the front edge, pointing to the room."""
        size = self._scene.assets[item.asset_id].size_m
        pose = item.pose_world_asset
        if abs(pose.rotation[2, 2]) < 0.9:
            return
        tip = pose.apply((size[0] / 2, 0.0, 0.0))
        base = max(0.0, size[0] / 2 - 0.09)
        left, right = pose.apply((base, 0.06, 0.0)), pose.apply((base, -0.06, 0.0))
        corners = [self._px(*p[:2]) for p in (tip, left, right)]
        self._draw.polygon(corners, fill=color)
        x, y = zip(*corners, strict=True)
        self._marks.append((min(x), min(y), max(x), max(y)))

    def _box(self, low_m: Sequence[float], high_m: Sequence[float]) -> Box:
        """Return a rectangle of the floor in pixels."""
        (left, bottom), (right, top) = self._px(*low_m[:2]), self._px(*high_m[:2])
        return (left, top, right, bottom)

    def _px(self, x: float, y: float) -> tuple[int, int]:
        return (
            int(_MARGIN_PX + (x - self._low[0]) * self._scale),
            int(_MARGIN_PX + (self._high[1] - y) * self._scale),
        )


def _dot_color(item: SceneObject) -> str:
    return "#204a87" if item.fixed else "#1b7f3b"


def _area(box: Box) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])


def _middle(box: Box) -> tuple[int, int]:
    return (box[0] + box[2]) // 2, (box[1] + box[3]) // 2
