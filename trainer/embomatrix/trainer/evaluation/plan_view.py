"""Executed plan on the plan view of its scene. Each step is marked at its object's initial position."""

import math
from collections.abc import Sequence
from typing import Final

from embomatrix.pages.plan_view import OVERHEAD_M, PlanView
from embomatrix.skills.syntax import Plan, SkillCall
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task

FIT_PX: Final = (560.0, 430.0)
"""Maximum width and height. Text keeps its size."""
MIN_FURNITURE_M: Final = 0.3
MARK_PX: Final = 9
"""Radius of a step's mark."""
_REACH: Final = 7
_CELLS: Final = tuple(
    sorted(
        ((right, down) for right in range(-_REACH, _REACH + 1) for down in range(-_REACH, _REACH + 1)),
        # To the right before below, and to the left last: numbers are read like a text.
        key=lambda cell: math.hypot(cell[0], 1.5 * cell[1]) + (cell[0] < 0) + (cell[1] < 0) / 2,
    )
)
"""Places for a mark around its object, the best first, in diameters."""


def css_class(verdict: AnswerVerdict, number: int) -> str:
    """CSS class of a step, counted from 1."""
    if number <= verdict.done:
        return "ok"
    return "bad" if number == verdict.step else "not"


def plan_view(scene: Scene, task: Task, plan: Plan, verdict: AnswerVerdict) -> str:
    """Return inline SVG. The page's CSS colours the classes room, piece, used, route, ok, bad and not."""
    objects = [_objects(scene, task, call) for call in plan]
    used = {name for names in objects for name in names}
    rooms = {scene.robot.room, *(scene.by_name[name].room for name in used)}
    rooms |= {call.room_name for call in plan if call.room_name is not None}
    view = PlanView(scene, rooms, margin_m=0.25, fit=FIT_PX)
    # The robot goes to a call's first object.
    marks = [
        (number, scene.box_of(names[0]).center_m[:2])
        for number, names in enumerate(objects, start=1)
        if names
    ]
    start = (scene.robot.x_m, scene.robot.y_m)
    x, y = view.at(*start)
    parts = [
        *(view.box(room.low_m, room.high_m, "room", room.name) for room in scene.rooms),
        *_furniture(scene, view, used),
        # Of other rooms only an edge is in the view, which would cut their names off.
        *(view.text(*room.low_m, room.name, 'class="name"', 4, -4) for room in view.rooms),
        *_labels(scene, view, used),
        view.line([start, *(point for _, point in marks)], "route"),
        f'<circle class="robot" cx="{x}" cy="{y}" r="6"><title>initial position of the robot</title></circle>',
    ]
    for (number, _), (x, y) in zip(marks, apart([view.at(*point) for _, point in marks]), strict=True):
        parts.append(
            f'<circle class="{css_class(verdict, number)}" cx="{x}" cy="{y}" r="{MARK_PX}"/>'
            f'<text class="number" x="{x}" y="{y + 4}" text-anchor="middle">{number}</text>'
        )
    return view.svg(parts, f"plan of {task.task_id} on the plan view")


def apart(points: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return centres of marks near these points, in pixels, so that no mark covers another one if there is room nearby."""
    taken: list[tuple[int, int]] = []
    for x, y in points:
        places = [(x + 2 * MARK_PX * right, y + 2 * MARK_PX * down) for right, down in _CELLS]
        free = (place for place in places if all(math.dist(place, other) >= 2 * MARK_PX for other in taken))
        taken.append(next(free, places[0]))
    return taken


def _objects(scene: Scene, task: Task, call: SkillCall) -> list[str]:
    """Objects of a call that are in the task's table and in the scene."""
    rows = (call.object_index, call.source_index)
    names = [task.table[row] for row in rows if row is not None and 0 <= row < len(task.table)]
    return [name for name in names if name in scene.by_name]


def _furniture(scene: Scene, view: PlanView, used: set[str]) -> list[str]:
    """Large objects and used ones, from low to high."""
    boxes = [
        (item.name in used, scene.box_of(item.name), item.name) for item in scene.objects if not item.absent
    ]
    shown = [
        entry
        for entry in boxes
        if entry[0] or (max(entry[1].size_m[:2]) >= MIN_FURNITURE_M and entry[1].low_m[2] < OVERHEAD_M)
    ]
    shown.sort(key=lambda entry: (entry[0], entry[1].low_m[2]))
    return [
        view.box(box.low_m, box.high_m, "used" if is_used else "piece", name) for is_used, box, name in shown
    ]


def _labels(scene: Scene, view: PlanView, used: set[str]) -> list[str]:
    """Names of the used objects below their boxes."""
    boxes = [(name, scene.box_of(name)) for name in sorted(used)]
    return [
        view.text(box.center_m[0], box.low_m[1], name, 'class="label" text-anchor="middle"', 0, 10)
        for name, box in boxes
    ]
