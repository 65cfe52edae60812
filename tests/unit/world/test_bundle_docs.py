"""docs/bundles.md agrees with the code: keys, values and limits of a bundle's JSON, its arrays, and its example."""

import gzip
import json
import math
import re
import struct
import zlib
from pathlib import Path

import msgspec
import msgspec.inspect as shapes
import pytest
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.world import records
from embomatrix.world.bundle import Bundle, BundleJson, encode_bundle
from embomatrix.world.goal import Quantifier
from embomatrix.world.inflation import DEFAULT_LIMITS
from embomatrix.world.placements import RELATIONS
from embomatrix.world.poses import PoseCache, StandPose
from embomatrix.world.tables import COLUMNS, SHAPES

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "bundles.md").read_text(encoding="utf-8")
LARGEST = records.Number.__metadata__[0].le
KINDS = {
    "bundle": BundleJson,
    "scene": records.SceneJson,
    "room": records.RoomJson,
    "doorway": records.DoorwayJson,
    "window": records.WindowJson,
    "robot": records.RobotJson,
    "object": records.ObjectJson,
    "background object": records.BackgroundJson,
    "asset": records.AssetJson,
    "link": records.LinkJson,
    "joint": records.JointJson,
    "surface": records.SurfaceJson,
    "interior": records.InteriorJson,
    "credit": records.CreditJson,
    "task": records.TaskJson,
    "pose cache": records.PosesJson,
}
"""Records of a bundle's JSON by the name that the page gives them. A part is a row in bundles."""
NAMES = {kind: name for name, kind in KINDS.items()}


def value_of(kind: shapes.Type) -> str:
    """Return the allowed values of a key as the page writes them."""
    match kind:
        case shapes.StrType(pattern=str()):
            return "name"
        case shapes.StrType(max_length=most):
            return "text" if most is None else f"text, at most {most:,} characters"
        case shapes.BoolType():
            return "true or false"
        case shapes.FloatType() | shapes.IntType():
            return number(kind)
        case shapes.EnumType(cls=members):
            return "one of " + " ".join(f"`{member.value}`" for member in members)
        case shapes.StructType(cls=records.PartJson):
            return "row of `parts`"
        case shapes.StructType(cls=records.PosesJson):
            return "poses"
        case shapes.StructType(cls=record):
            return NAMES[record]
        case shapes.TupleType(item_types=items):
            return tuple_of([value_of(item) for item in items])
        case shapes.UnionType(types=(shapes.TupleType(), shapes.IntType())):
            return "row of `poses`"
        case shapes.UnionType(types=types):
            return value_of(next(kind for kind in types if not isinstance(kind, shapes.IntType)))
        case shapes.DictType(key_type=key, value_type=value, max_length=most):
            limit = "" if most is None else f"; at most {most:,} keys"
            return f"map of {value_of(key)} to: {value_of(value)}{limit}"
        case shapes.VarTupleType() | shapes.ListType():
            return list_of(kind)
    raise AssertionError(f"the page has no words for {kind}")


def number(kind: shapes.FloatType | shapes.IntType) -> str:
    low = "above" if kind.ge is None else "from"
    first, last = kind.gt if kind.ge is None else kind.ge, kind.le
    word = "number" if isinstance(kind, shapes.FloatType) else "whole number"
    if first is None or first == -LARGEST:
        return word
    return f"{word} {low} {first:,g}" + (f" to {last:,.15g}" if last is not None else "")


def tuple_of(items: list[str]) -> str:
    if len(set(items)) == 1:
        return f"list of {len(items)}: {items[0]}"
    return f"list of {', '.join(items)}"


def list_of(kind: shapes.VarTupleType | shapes.ListType) -> str:
    bounds = [f"at least {kind.min_length}"] if kind.min_length else []
    bounds += [f"at most {kind.max_length:,}"] if kind.max_length else []
    return f"list of: {value_of(kind.item_type)}" + (f", {', '.join(bounds)}" if bounds else "")


def keys_of(record: type[msgspec.Struct]) -> dict[str, str]:
    """Return the keys of a record with their values; a question mark follows a key that may be missing."""
    kind = shapes.type_info(record)
    return {
        f"{field.encode_name}{'' if field.required else '?'}": value_of(field.type) for field in kind.fields
    }


def table_of(heading: str) -> dict[str, str]:
    """Return the table whose first column has this heading: first cells mapped to the second ones."""
    found = re.search(rf"^\| {heading} \|.*\n\| ---.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert found, f"docs/bundles.md has no table of {heading}"
    cells = [line.strip("|").split(" | ") for line in found[1].splitlines()]
    return {name.strip().replace("`", ""): value.strip() for name, value, *_ in cells}


@pytest.mark.parametrize("name", KINDS)
def test_page_lists_every_key_of_a_record_with_its_values(name):
    assert table_of(f"key of {'an' if name[0] in 'aio' else 'a'} {name}") == keys_of(KINDS[name])


def test_page_lists_the_limits_with_their_values():
    written = {name: value.replace(",", "") for name, value in table_of("limit").items() if name != "digest"}
    assert {name: float(value) for name, value in written.items()} == {
        "compressed_bytes": DEFAULT_LIMITS.compressed_bytes,
        "ratio": DEFAULT_LIMITS.ratio,
        "content_bytes": DEFAULT_LIMITS.content_bytes,
        "values": DEFAULT_LIMITS.values,
    }


def test_page_lists_every_array_with_its_shapes_and_relations():
    assert list(table_of("array")) == list(COLUMNS)
    for index, word in (*enumerate(SHAPES), *enumerate(RELATIONS)):
        assert f"{index} `{word.value}`" in PAGE


def test_page_lists_every_form_of_a_goal():
    forms = {form.split()[0].strip("(") for form in table_of("formula")}
    assert forms == {"PREDICATE", "not", "and", "or", "imply", *Quantifier}


def test_page_lists_every_key_of_the_table_of_substances():
    data = gzip.decompress((ROOT / "core/embomatrix/world/data/substances.json.gz").read_bytes())
    assert set(table_of("key of the substances")) == set(json.loads(data))


def test_page_lists_every_ability_that_rules_and_factory_ask_for():
    folders = (ROOT / "core/embomatrix/sim", ROOT / "core/embomatrix/skills")
    asked = re.compile(r'(?:\.can\(|abilities\.get\(|_thermal_source\(asset, )"(\w+)"')
    used = {
        name
        for folder in folders
        for file in folder.rglob("*.py")
        for name in asked.findall(file.read_text())
    }
    by_the_factory = {"openable"}
    assert {name for cell in table_of("ability") for name in cell.split(", ")} == used | by_the_factory


def content_of(data: bytes) -> tuple[dict, dict[str, list[tuple]]]:
    """Read JSON and rows of arrays by the page alone, without our code."""
    content = zlib.decompress(data)
    magic, version, size = struct.unpack_from("<4sII", content)
    assert (magic, version, (12 + size) % 8) == (b"EMBX", 3, 0)
    value = json.loads(content[12 : 12 + size])
    at, rows = 12 + size, {}
    for name, (kind, count, *columns) in value["arrays"].items():
        letter = {"<f8": "d", "<i4": "i", "|u1": "B"}[kind]
        width = math.prod(columns)
        row = struct.Struct(f"<{width}{letter}")
        rows[name] = [row.unpack_from(content, at + index * row.size) for index in range(count)]
        at += -(-count * row.size // 8) * 8
    assert at == len(content)
    return value, rows


def test_reader_written_from_the_page_finds_poses_parts_and_stands():
    scene = kitchen_scene()
    tasks = {task.task_id: task for task in kitchen_tasks(scene)}
    stands = {scene.objects[0].name: (StandPose(1.0, 2.0, 0.5), StandPose(1.5, 2.0, 0.25))}
    value, rows = content_of(encode_bundle(Bundle(scene, tasks, PoseCache(stands=stands))))
    for written, item in zip(value["scene"]["objects"], scene.objects, strict=True):
        pose = item.pose_world_asset
        assert rows["poses"][written["pose"]] == (*pose.position_m, *pose.quat_xyzw)
    for row, part in zip(value["scene"]["walls"], scene.walls, strict=True):
        assert rows["parts"][row] == (*part.pose.position_m, *part.pose.quat_xyzw, *part.size_m)
        assert SHAPES[rows["kinds"][row][0]] is part.shape
    first, count = value["poses"]["stands"][scene.objects[0].name]
    assert rows["stands"][first : first + count] == [(1.0, 2.0, 0.5), (1.5, 2.0, 0.25)]
    assert [task["task_id"] for task in value["tasks"]] == sorted(tasks)
