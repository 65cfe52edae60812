"""Tasks and pose caches encoded as JSON values and decoded again."""

from collections.abc import Mapping
from typing import Any

from embomatrix.world.bddl import BddlError, parse_formula
from embomatrix.world.evaluate import GoalError, check_size, objects_of
from embomatrix.world.placements import flattened
from embomatrix.world.poses import PoseCache
from embomatrix.world.records import PosesJson, SceneInvalidError, TaskJson
from embomatrix.world.state import Relation
from embomatrix.world.tables import Tables, TableWriter
from embomatrix.world.task import Profile, Task

Json = dict[str, Any]


def task_to_json(task: Task) -> Json:
    """Task as JSON values. The paper's profile is the default and is left out."""
    value = {
        "task_id": task.task_id,
        "scene_id": task.scene_id,
        "instruction": task.instruction,
        "category": task.category.value,
        "goal": task.goal_bddl,
        "table": [*task.table],
        "types": {key: [*names] for key, names in task.types.items()},
        "source": task.source,
    }
    if task.profile is not Profile.PAPER:
        value["profile"] = task.profile.value
    return value


def task_of(record: TaskJson, path: str) -> Task:
    """Task of a record; ``path`` names the record in errors. Raises SceneInvalidError."""
    if len(set(record.table)) != len(record.table):
        raise SceneInvalidError(f"{path}.table", "names an object twice: expected each once")
    members = {name: key for key, names in record.types.items() for name in names}
    try:
        goal = parse_formula(record.goal, {**dict.fromkeys(record.table, ""), **members})
        missing = objects_of(goal, record.types) - set(record.table)
        scored = check_size(goal, record.types)
    except (BddlError, GoalError) as error:
        raise SceneInvalidError(f"{path}.goal", str(error)) from error
    if not scored:
        raise SceneInvalidError(
            f"{path}.goal", "has no scored atom, so it holds whatever the robot does: expected one"
        )
    if missing:
        raise SceneInvalidError(f"{path}.goal", f"names {min(missing)!r}, which is not in the object table")
    return Task(
        task_id=record.task_id,
        scene_id=record.scene_id,
        instruction=record.instruction,
        category=record.category,
        goal=goal,
        goal_bddl=record.goal,
        table=record.table,
        types=record.types,
        source=record.source,
        profile=record.profile,
    )


def poses_to_json(poses: PoseCache, tables: TableWriter) -> Json:
    """Pose cache as JSON values that refer to rows of ``tables``; empty kinds of knowledge about the arm are left out."""
    names, sets, spots = flattened(poses.placements)
    tables.placements(sets, spots)
    stands = {
        name: [
            tables.stands([(float(pose.x_m), float(pose.y_m), float(pose.yaw)) for pose in found]),
            len(found),
        ]
        for name, found in poses.stands.items()
    }
    arm: Json = {
        "barred": {handling.value: dict(found) for handling, found in poses.arm_blockers.items() if found},
        "barred_places": _by_relation(poses.placing_blockers),
        "reached": _by_relation(poses.reached),
    }
    return {"placements": names, "stands": stands, **{key: found for key, found in arm.items() if found}}


def poses_of(record: PosesJson, tables: Tables) -> PoseCache:
    """Pose cache of a record. Raises SceneInvalidError for rows that the tables lack."""
    return PoseCache(
        tables.placements(record.placements),
        tables.stands(record.stands),
        record.barred,
        record.reached,
        record.barred_places,
    )


def _by_relation(known: Mapping[Relation, Mapping[str, Mapping[str, Any]]]) -> Json:
    return {
        relation.value: {held: dict(targets) for held, targets in found.items()}
        for relation, found in known.items()
        if found
    }
