"""Floor plan of a scene, and object positions during a plan, for the dashboard.

The manager has no physics: a moved object appears at the centre of its target. ``embomatrix factory inspect`` shows
verified poses.
"""

from collections.abc import Container
from dataclasses import replace
from typing import Final

from embomatrix.manager.web.gallery_values import Box, FloorPlanView, MomentView
from embomatrix.skills.describe import call_in_words
from embomatrix.skills.syntax import Plan, Skill, SkillCall
from embomatrix.world.geometry import IDENTITY, Vec2, Vec3
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task

HUNG_M: Final = 1.6
"""Objects whose lower edge is above this height are left out."""
SMALL_M: Final = 0.2
"""Smaller objects are drawn as dots if a task names them, else left out."""
SKIRTING_M: Final = 0.1
"""Walls whose lower edge is above this height are lintels or panes: the plan shows an opening."""
PIECES: Final = 1500
"""Most walls, and most pieces of furniture, that are drawn."""


def floor_plan(scene: Scene) -> FloorPlanView:
    """Return the plan of the whole scene."""
    walls = [wall.aabb(IDENTITY) for wall in scene.walls[:PIECES]]
    boxes = [(item, scene.box_of(item.name)) for item in scene.objects if not item.absent]
    pieces = [
        _box(item.name, box.low_m, box.high_m)
        for item, box in sorted(boxes, key=lambda entry: entry[1].low_m[2])
        if box.low_m[2] < HUNG_M and max(box.size_m[:2]) >= SMALL_M
    ]
    return FloorPlanView(
        [_box(room.name, room.low_m, room.high_m) for room in scene.rooms],
        [_box("", wall.low_m, wall.high_m) for wall in walls if wall.low_m[2] < SKIRTING_M],
        pieces[:PIECES],
        _rounded(scene.robot.x_m, scene.robot.y_m),
    )


def movable_objects(scene: Scene, task: Task) -> dict[str, list[float]]:
    """Return the start positions of the task's movable objects."""
    found = [scene.by_name[name] for name in task.table if name in scene.by_name]
    return {item.name: _middle(scene, item.name) for item in found if not item.fixed and not item.absent}


def moments_of(
    scene: Scene, task: Task, plan: Plan, failed: Container[int] = frozenset()
) -> list[MomentView]:
    """Return the state at the start and after each call of the plan. Calls at the places in ``failed`` change nothing."""
    moments = [MomentView("", _rounded(scene.robot.x_m, scene.robot.y_m))]
    for place, call in enumerate(plan):
        if place in failed:
            moments.append(replace(moments[-1], call=call_in_words(call, task.table)))
        else:
            moments.append(_after(scene, task, call, moments[-1]))
    return moments


def _after(scene: Scene, task: Task, call: SkillCall, before: MomentView) -> MomentView:
    target = _named(scene, task, call.object_index)
    robot, held, things, active = before.robot, [*before.held], {**before.things}, [*before.active]
    match call.skill:
        case Skill.GO_TO_ROOM:
            room = next((room for room in scene.rooms if room.name == call.room_name), None)
            robot = robot if room is None else _rounded(*room.center_m)
        case Skill.MOVE if target:
            robot = _beside(scene, target, things.get(target), robot)
        case Skill.PICK_UP if target:
            held.append(target)
        case Skill.PLACE if target and held:
            things[held.pop()] = things.get(target) or _middle(scene, target)
        case Skill.OPEN | Skill.TOGGLE_ON if target and target not in active:
            active.append(target)
        case Skill.CLOSE | Skill.TOGGLE_OFF if target in active:
            active.remove(target)
        case _:
            pass
    things |= dict.fromkeys(held, robot)
    return MomentView(call_in_words(call, task.table), robot, held, things, active)


def _beside(scene: Scene, name: str, at: list[float] | None, robot: list[float]) -> list[float]:
    """Return the point of the object's box that is nearest to the robot."""
    if at is not None:
        return at
    box = scene.box_of(name)
    west, south, east, north = box.low_m[0], box.low_m[1], box.high_m[0], box.high_m[1]
    inside = [min(max(robot[0], west), east), min(max(robot[1], south), north)]
    return _rounded(*inside)


def _named(scene: Scene, task: Task, row: int | None) -> str:
    """Return the object in that row; empty if the table or the scene lacks it."""
    name = task.table[row] if row is not None and 0 <= row < len(task.table) else ""
    return name if name in scene.by_name else ""


def _middle(scene: Scene, name: str) -> list[float]:
    return _rounded(*scene.box_of(name).center_m[:2])


def _box(name: str, low_m: Vec2 | Vec3, high_m: Vec2 | Vec3) -> Box:
    return (name, round(low_m[0], 2), round(low_m[1], 2), round(high_m[0], 2), round(high_m[1], 2))


def _rounded(*metres: float) -> list[float]:
    """Round to centimetres, finer than a line of the drawing."""
    return [round(value, 2) for value in metres]
