"""Plan view of a scene for the inspection page, with markers for the robot and the task's small objects."""

from collections.abc import Collection
from html import escape
from typing import Final

from embomatrix.factory.pictures.scene import is_overhead
from embomatrix.pages.plan_view import PlanView
from embomatrix.world.geometry import IDENTITY
from embomatrix.world.scene import Scene

UNIT: Final = 100
"""SVG units per metre."""
ROBOT_M: Final = 0.25
DOT_M: Final = 0.1


def inspection_view(scene: Scene, view: PlanView, about: Collection[str], things: Collection[str]) -> str:
    """Return inline SVG. ``about``: objects that the goal mentions; ``things``: small objects, marked by name."""
    names = {room.name for room in view.rooms}
    parts = [view.box(room.low_m, room.high_m, "room") for room in view.rooms]
    for wall in scene.walls:
        box = wall.aabb(IDENTITY)
        if box.low_m[2] < 0.1 and view.is_visible(box.low_m, box.high_m):
            parts.append(view.box(box.low_m, box.high_m, "wall"))
    for item in scene.objects:
        box = scene.box_of(item.name)
        if item.room in names and item.name not in things and not is_overhead(box) and not item.absent:
            kind = "piece goal" if item.name in about else "piece"
            parts.append(view.box(box.low_m, box.high_m, kind, item.name))
    parts += [
        view.text(room.low_m[0], room.high_m[1], room.name.replace("_", " "), "", 12, 34)
        for room in view.rooms
    ]
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
    return view.svg(parts, "plan of the scene", 'id="plan"')
