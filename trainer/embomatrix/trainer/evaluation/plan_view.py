"""A plan on the plan view of its scene: rooms and furniture from above, each step where its object is at the start."""

from __future__ import annotations

import html
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.skills.syntax import Plan, SkillCall
    from embomatrix.world.geometry import Vec2
    from embomatrix.world.scene import Room, Scene
    from embomatrix.world.task import Task

WIDTH: Final = 560.0
HEIGHT: Final = 430.0
"""Pixels of a picture, at most so many high: names keep their size."""
MARGIN_M: Final = 0.25
MIN_FURNITURE_M: Final = 0.3
HUNG_M: Final = 1.6
"""What begins higher hangs over the robot's way and is left out."""
MARK_PX: Final = 9.0
LABEL_PX: Final = 10.0


@dataclass(frozen=True, slots=True)
class Drawn:
    """What a picture shows of an execution: ``done`` steps succeeded, and the next one failed if ``failed``."""

    plan: Plan
    done: int
    failed: bool


def plan_view(scene: Scene, task: Task, drawn: Drawn) -> str:
    """Inline SVG, north up. Colours are CSS classes of the page: room, thing, used, way, ok, bad and not."""
    view = _View(scene, _rooms(scene, task, drawn.plan))
    used = {name for call in drawn.plan for name in _names(task, call)}
    marks = _marks(scene, task, drawn.plan)
    return "".join(
        [
            f'<svg viewBox="0 0 {WIDTH:.0f} {view.height:.0f}" role="img" '
            f'aria-label="The plan of {html.escape(task.task_id)} on the plan view">',
            *view.rooms(),
            *view.furniture(used),
            *view.room_names(),
            *view.labels(used),
            *view.route([(scene.robot.x_m, scene.robot.y_m), *(point for _, point in marks)]),
            view.robot(),
            *view.marks(marks, drawn),
            "</svg>",
        ]
    )


def _names(task: Task, call: SkillCall) -> list[str]:
    """Objects of a call that the task's table lists, the one that the robot goes to first."""
    rows = (call.object_index, call.source_index)
    return [task.table[row] for row in rows if row is not None and 0 <= row < len(task.table)]


def _marks(scene: Scene, task: Task, plan: Plan) -> list[tuple[int, Vec2]]:
    """(number of the step from 1, where): steps without an object have no place of their own."""
    found = []
    for number, call in enumerate(plan, start=1):
        names = [name for name in _names(task, call) if name in scene.by_name]
        if names:
            x, y, _ = scene.box_of(names[0]).center_m
            found.append((number, (x, y)))
    return found


def _rooms(scene: Scene, task: Task, plan: Plan) -> tuple[Room, ...]:
    """Rooms that the plan is about and the one that the robot starts in."""
    names = {scene.robot.room}
    for call in plan:
        names |= {scene.by_name[name].room for name in _names(task, call) if name in scene.by_name}
        names.add(call.room_name or "")
    return tuple(room for room in scene.rooms if room.name in names) or scene.rooms


class _View:
    """Metres to pixels, and the shapes of the picture in the order in which they are drawn."""

    def __init__(self, scene: Scene, shown: Sequence[Room]) -> None:
        self._scene = scene
        self._low = (
            min(room.low_m[0] for room in shown) - MARGIN_M,
            min(room.low_m[1] for room in shown) - MARGIN_M,
        )
        high = (
            max(room.high_m[0] for room in shown) + MARGIN_M,
            max(room.high_m[1] for room in shown) + MARGIN_M,
        )
        self._high = high
        size_m = (high[0] - self._low[0], high[1] - self._low[1])
        self._scale = min(WIDTH / size_m[0], HEIGHT / size_m[1])
        self._left = (WIDTH - size_m[0] * self._scale) / 2
        self.height = size_m[1] * self._scale

    def _px(self, x_m: float, y_m: float) -> Vec2:
        return (self._left + (x_m - self._low[0]) * self._scale, (self._high[1] - y_m) * self._scale)

    def _rectangle(self, low: Vec2, high: Vec2, kind: str, title: str = "") -> str:
        left, top = self._px(low[0], high[1])
        right, bottom = self._px(high[0], low[1])
        told = f"<title>{html.escape(title)}</title>" if title else ""
        return (
            f'<rect class="{kind}" x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" '
            f'height="{bottom - top:.1f}">{told}</rect>'
        )

    def rooms(self) -> list[str]:
        return [self._rectangle(room.low_m, room.high_m, "room", room.name) for room in self._scene.rooms]

    def room_names(self) -> list[str]:
        shapes = []
        for room in self._scene.rooms:
            x, y = self._px(room.low_m[0], room.low_m[1])
            name = html.escape(room.name)
            shapes.append(f'<text class="name" x="{x + 4:.1f}" y="{y - 4:.1f}">{name}</text>')
        return shapes

    def furniture(self, used: set[str]) -> list[str]:
        """Larger things, and whatever the plan names; low ones first."""
        boxes = [
            (self._scene.box_of(item.name), item.name) for item in self._scene.objects if not item.absent
        ]
        shown = [
            (box, name)
            for box, name in boxes
            if name in used or (max(box.size_m[:2]) >= MIN_FURNITURE_M and box.low_m[2] < HUNG_M)
        ]
        shown.sort(key=lambda entry: (entry[1] in used, entry[0].low_m[2]))
        return [
            self._rectangle(box.low_m[:2], box.high_m[:2], "used" if name in used else "thing", name)
            for box, name in shown
        ]

    def labels(self, used: set[str]) -> list[str]:
        """Names of what the plan names, under their boxes."""
        shapes = []
        for name in sorted(used & self._scene.by_name.keys()):
            box = self._scene.box_of(name)
            x, y = self._px(box.center_m[0], box.low_m[1])
            shapes.append(
                f'<text class="label" x="{x:.1f}" y="{y + LABEL_PX:.1f}" text-anchor="middle">{html.escape(name)}</text>'
            )
        return shapes

    def robot(self) -> str:
        x, y = self._px(self._scene.robot.x_m, self._scene.robot.y_m)
        return f'<circle class="robot" cx="{x:.1f}" cy="{y:.1f}" r="6"><title>the robot at the start</title></circle>'

    def route(self, points: Sequence[Vec2]) -> list[str]:
        told = " ".join(f"{x:.1f},{y:.1f}" for x, y in (self._px(*point) for point in points))
        return [f'<polyline class="way" points="{told}"/>']

    def marks(self, marks: Sequence[tuple[int, Vec2]], drawn: Drawn) -> list[str]:
        """Numbers of the steps; those at one place stand side by side."""
        crowd: dict[Vec2, int] = {}
        shapes = []
        for number, point in marks:
            before = crowd.get(point, 0)
            crowd[point] = before + 1
            x, y = self._px(*point)
            x += before * 2 * MARK_PX
            kind = (
                "ok"
                if number <= drawn.done
                else "bad"
                if drawn.failed and number == drawn.done + 1
                else "not"
            )
            shapes.append(
                f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="{MARK_PX}"/>'
                f'<text class="number" x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle">{number}</text>'
            )
        return shapes
