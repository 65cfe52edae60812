"""The paper's verification of a scene: the robot moves to each object of the task and picks up what it can carry.

Each object is tried in the simulator from the start state. Doors in front of it are opened first. Objects that carry others
are not picked up.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Final

from embomatrix.factory.scenes.view import SceneView
from embomatrix.sim.executor import Simulator
from embomatrix.skills.limits import ROBOT
from embomatrix.skills.syntax import Plan, Skill, SkillCall
from embomatrix.world.state import Relation
from embomatrix.world.task import Task

SEED: Final = 0


def out_of_hand(simulator: Simulator, task: Task, view: SceneView, names: Sequence[str]) -> tuple[str, ...]:
    """Return the objects that the robot can't reach, or can't pick up although they are portable, each with the reason.

    Objects that are absent at the start, or hang higher than the arm reaches, are skipped.
    """
    found = []
    for name in names:
        item = view.item(name)
        low = item.pose_world_asset.position_m[2] - view.asset(name).size_m[2] / 2
        if item.absent or low > ROBOT.reach_high_m or name not in task.table:
            continue
        why = ""
        for plan in _plans(task, view, name):
            trace = simulator.execute(task, plan, SEED)
            why = trace.steps[-1].message if trace.failure is not None else ""
            if not why:
                break
        if why:
            found.append(f"{name} ({why})")
    return tuple(found)


def _plans(task: Task, view: SceneView, name: str) -> Iterator[Plan]:
    """Yield plans to reach an object: after opening what encloses it, with and without moving to the object itself."""
    shut = [
        host
        for inner, host in itertools.pairwise((name, *view.hosts(name)))
        if view.rests(inner, Relation.INSIDE, host) and view.is_openable(host) and not view.is_open(host)
    ]
    bears = any(item.host == name for item in view.scene.objects)
    go = _call(task, Skill.MOVE, name)
    take = [_call(task, Skill.PICK_UP, name)] if view.is_portable(name) and not bears else []
    opened = [
        _call(task, skill, host)
        for host in reversed(shut)
        if host in task.table
        for skill in (Skill.MOVE, Skill.OPEN)
    ]
    yield (*opened, go, *take)
    if opened:
        yield (*opened, *take)


def _call(task: Task, skill: Skill, name: str) -> SkillCall:
    return SkillCall(skill, object_index=task.table.index(name))
