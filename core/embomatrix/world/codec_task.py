"""Tasks and pose caches as plain JSON values, and back, as strictly as scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, TypeVar

from embomatrix.world.bddl import BddlError, parse_formula
from embomatrix.world.codec_asset import pose_from_field, pose_to_json
from embomatrix.world.evaluate import GoalError, objects_of
from embomatrix.world.field import Field
from embomatrix.world.placements import flattened
from embomatrix.world.poses import Handling, PlacementKey, PoseCache, StandPose
from embomatrix.world.state import Relation
from embomatrix.world.task import MAX_TABLE, Profile, Task, TaskCategory

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from embomatrix.world.goal import Formula
    from embomatrix.world.tables import Tables, TableWriter

    Json = dict[str, Any]

T = TypeVar("T")
ARM: Final = ("barred", "barred_places", "reached")
"""What a bundle may tell about the arm."""


def task_to_json(task: Task) -> Json:
    """The profile is written where it is not the paper's: data sets from before there were two read the same."""
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


def task_from_json(value: object) -> Task:
    """A task whose goal speaks of objects in its table only. Raises SceneInvalidError."""
    fields = Field(value, "task").record(
        "task_id",
        "scene_id",
        "instruction",
        "category",
        "goal",
        "table",
        "types",
        "source",
        optional=("profile",),
    )
    table = tuple(item.name() for item in fields["table"].items(at_most=MAX_TABLE))
    if len(set(table)) != len(table):
        fields["table"].fail("an object stands in it twice: expected each once")
    types = {key: names.texts() for key, names in fields["types"].entries()}
    return Task(
        task_id=fields["task_id"].name(),
        scene_id=fields["scene_id"].name(),
        instruction=fields["instruction"].text(),
        category=fields["category"].member(TaskCategory),
        goal=_goal(fields["goal"], table, types),
        goal_bddl=fields["goal"].text(),
        table=table,
        types=types,
        source=fields["source"].text(),
        profile=fields["profile"].member(Profile) if "profile" in fields else Profile.PAPER,
    )


def _goal(field: Field, table: tuple[str, ...], types: Mapping[str, tuple[str, ...]]) -> Formula:
    declared = {**dict.fromkeys(table, ""), **{name: key for key, names in types.items() for name in names}}
    try:
        goal = parse_formula(field.text(), declared)
        missing = objects_of(goal, types) - set(table)
    except (BddlError, GoalError) as error:
        field.fail(str(error))
    if missing:
        field.fail(f"speaks of {min(missing)!r}, which is not in the object table")
    return goal


def poses_to_json(poses: PoseCache, tables: TableWriter | None = None) -> Json:
    """JSON values. Poses are arrays of ``tables`` where they are given, and the assets of the placements their names."""
    stands = {name: _stands_to_json(found, tables) for name, found in poses.stands.items()}
    if tables is not None:
        names, sets, spots = flattened(poses.placements)
        tables.placements(sets, spots)
        return {"placements": names, "stands": stands, **_arm_to_json(poses)}
    placements = [
        {
            "asset_id": key.asset_id,
            "support_asset_id": key.support_asset_id,
            "relation": key.relation.value,
            "poses": [pose_to_json(pose) for pose in found],
        }
        for key, found in poses.placements.items()
    ]
    return {"placements": placements, "stands": stands, **_arm_to_json(poses)}


def poses_from_json(value: object, tables: Tables | None = None) -> PoseCache:
    """A pose cache; ``tables`` hold the rows that it was written with. Raises SceneInvalidError."""
    fields = Field(value, "poses", tables=tables).record("placements", "stands", optional=ARM)
    barred = _barred_from_json(fields["barred"]) if "barred" in fields else {}
    reached = _placings_from_json(fields["reached"], _pose_number) if "reached" in fields else {}
    places = _placings_from_json(fields["barred_places"], Field.name) if "barred_places" in fields else {}
    if tables is not None:
        names = [item.name() for item in fields["placements"].items()]
        stands_by_name = tables.stands(fields["stands"])
        return PoseCache(tables.placements(names), stands_by_name, barred, reached, places)
    stands = {
        name: tuple(StandPose(*stand.vec3()) for stand in found.items())
        for name, found in fields["stands"].entries()
    }
    placements = {}
    for item in fields["placements"].items():
        entry = item.record("asset_id", "support_asset_id", "relation", "poses")
        key = PlacementKey(
            entry["asset_id"].name(), entry["support_asset_id"].name(), entry["relation"].member(Relation)
        )
        if key in placements:
            item.fail("the same placement stands in the cache twice")
        placements[key] = tuple(pose_from_field(pose) for pose in entry["poses"].items())
    return PoseCache(placements, stands, barred, reached, places)


def _arm_to_json(poses: PoseCache) -> Json:
    """What is known of the arm, an entry for each kind of knowledge that there is any of."""
    known: Json = {
        "barred": {handling.value: dict(found) for handling, found in poses.barred.items() if found},
        "barred_places": _by_placing(poses.barred_places),
        "reached": _by_placing(poses.reached),
    }
    return {key: found for key, found in known.items() if found}


def _by_placing(known: Mapping[Relation, Mapping[str, Mapping[str, Any]]]) -> Json:
    return {
        relation.value: {held: dict(targets) for held, targets in found.items()}
        for relation, found in known.items()
        if found
    }


def _barred_from_json(field: Field) -> dict[Handling, dict[str, str]]:
    kinds = field.record(optional=tuple(Handling))
    return {
        Handling(kind): {name: other.name() for name, other in found.entries()}
        for kind, found in kinds.items()
    }


def _placings_from_json(field: Field, read: Callable[[Field], T]) -> dict[Relation, dict[str, dict[str, T]]]:
    """What is known by relation, by what is held and by its target."""
    relations = field.record(optional=tuple(Relation))
    return {
        Relation(relation): {
            held: {target: read(item) for target, item in targets.entries()}
            for held, targets in found.entries()
        }
        for relation, found in relations.items()
    }


def _pose_number(field: Field) -> int:
    number = field.integer()
    if number < 0:
        field.fail(f"found {number}: expected the number of a pose, from 0")
    return number


def _stands_to_json(stands: tuple[StandPose, ...], tables: TableWriter | None) -> Any:
    """Triples, or the first row of ``tables`` that holds them and their number."""
    rows = [(float(stand.x_m), float(stand.y_m), float(stand.yaw)) for stand in stands]
    return [tables.stands(rows), len(rows)] if tables is not None else [[*row] for row in rows]
