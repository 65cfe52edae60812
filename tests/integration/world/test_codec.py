"""Decoding checks every rule that the engine needs; errors name the field."""

import contextlib
import copy
import json
import math
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.world.bundle import Bundle
from embomatrix.world.codec import asset_from_json, asset_to_json, scene_from_json, scene_to_json
from embomatrix.world.codec_task import poses_of, poses_to_json, task_of, task_to_json
from embomatrix.world.poses import PoseCache
from embomatrix.world.records import PosesJson, SceneInvalidError, TaskJson, convert
from embomatrix.world.scene import Scene, Window
from embomatrix.world.tables import Tables, TableWriter
from embomatrix.world.task import Task


def task_from_json(value: object) -> Task:
    return task_of(convert(value, TaskJson, "task"), "task")


def poses_from_json(value: object, tables: Tables) -> PoseCache:
    return poses_of(convert(value, PosesJson, "poses"), tables)


def through_text(value: Any) -> Any:
    return json.loads(json.dumps(value))


def test_scene_task_assets_and_poses_survive_json(scene: Scene, task: Task, bundle: Bundle) -> None:
    assert scene_from_json(through_text(scene_to_json(scene))) == scene
    assert task_from_json(through_text(task_to_json(task))) == task
    writer = TableWriter()
    poses = through_text(poses_to_json(bundle.poses, writer))
    assert poses_from_json(poses, Tables(writer.arrays())) == bundle.poses
    for asset in scene.assets.values():
        assert asset_from_json(through_text(asset_to_json(asset))) == asset


WINDOW = Window(("kitchen_0", ""), (1.0, 0.0), 0.8, 0.9, 1.8, "x", "ulnafj")


def test_windows_survive_json(scene: Scene) -> None:
    lit = replace(scene, windows=(WINDOW,))
    assert scene_from_json(through_text(scene_to_json(lit))) == lit


@pytest.mark.parametrize(
    ("window", "found"),
    [
        (replace(WINDOW, rooms=("attic_0", "")), "unknown room"),
        (replace(WINDOW, head_m=0.9), "expected 0 <= sill < head"),
        (replace(WINDOW, along="z"), "a wall along x or y"),
    ],
)
def test_error_names_the_invalid_window(scene: Scene, window: Window, found: str) -> None:
    with pytest.raises(SceneInvalidError, match=found) as caught:
        scene_from_json(scene_to_json(replace(scene, windows=(window,))))
    assert caught.value.field.startswith("scene.windows[0]")


BREAKS: dict[str, tuple[list[str | int], Any, str]] = {
    "nan position": (["objects", 0, "pose", 1], math.nan, "scene.objects[0].pose"),
    "infinite size": (["assets", "apple-red", "size_m", 0], math.inf, "size_m"),
    "quaternion of length 2": (["objects", 1, "pose", 6], 2.0, "scene.objects[1].pose"),
    "paper-thin part": (
        ["assets", "fridge-abc", "links", 0, "parts", 0, "size_m", 2],
        1e-4,
        "parts[0].size_m",
    ),
    "zero axis": (["assets", "fridge-abc", "links", 1, "joint", "axis"], [0.0, 0.0, 0.0], "joint.axis"),
    "joint without travel": (["assets", "fridge-abc", "links", 1, "joint", "upper"], 0.0, "joint.upper"),
    "unknown asset": (["objects", 1, "asset_id"], "pear-x", "scene.objects[1].asset_id"),
    "two of a name": (["objects", 1, "name"], "fridge_1", "scene.objects"),
    "two in one place": (["objects", 1, "pose"], [1.0, 2.5, 0.85, 0.0, 0.0, 0.0, 1.0], "scene.objects"),
    "nameless object": (["objects", 0, "name"], "", "scene.objects[0].name"),
    "unknown room": (["objects", 0, "room"], "attic_0", "scene.objects[0].room"),
    "unknown host": (["objects", 1, "host"], "table_9", "scene.objects[1].host"),
    "hosts itself": (["objects", 1, "host"], "apple_1", "scene.objects[1].host"),
    "unknown state": (["objects", 0, "states"], ["angry"], "scene.objects[0].states[0]"),
    "unknown shape": (["walls", 0, "shape"], "torus", "scene.walls[0].shape"),
    "hull without vertices": (["walls", 0, "shape"], "hull", "scene.walls[0]"),
    "joint beyond its travel": (["objects", 0, "joints"], [1.5], "scene.objects[0].joints"),
    "joints of another asset": (["objects", 0, "joints"], [0.1, 0.2], "scene.objects[0].joints"),
    "door of an unknown link": (
        ["assets", "fridge-abc", "interiors", 0, "closed_by"],
        ["lid"],
        "interiors[0].closed_by",
    ),
    "surface of an unknown cavity": (
        ["assets", "fridge-abc", "supports", 0, "interior"],
        "attic",
        "supports[0].interior",
    ),
    "massless asset": (["assets", "apple-red", "mass_kg"], 0.0, "mass_kg"),
    "text for a number": (["robot", "x_m"], "5", "scene.robot.x_m"),
    "truth for a number": (["robot", "yaw"], True, "scene.robot.yaw"),
    "room inside out": (["rooms", 0, "high_m"], [-1.0, 3.0], "scene.rooms[0]"),
    "doorway to nowhere": (["doorways", 0, "rooms"], ["kitchen_0", "attic_0"], "scene.doorways[0].rooms"),
    "slanted wall": (["doorways", 0, "along"], "z", "scene.doorways[0]"),
    "robot in no room": (["robot", "room"], "attic_0", "scene.robot.room"),
    "unknown key": (["robot", "speed"], 3.0, "scene.robot"),
    "asset under a wrong key": (["assets", "apple-red", "asset_id"], "apple-blue", "scene.assets"),
}


@pytest.mark.parametrize("name", BREAKS)
def test_error_names_the_field_that_breaks_a_rule(scene: Scene, name: str) -> None:
    path, value, field = BREAKS[name]
    broken = through_text(scene_to_json(scene))
    place = broken
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(SceneInvalidError) as caught:
        scene_from_json(broken)
    assert field in caught.value.field
    assert caught.value.field in str(caught.value)


def test_seventeenth_part_of_a_link_is_refused(scene: Scene) -> None:
    broken = through_text(scene_to_json(scene))
    parts = broken["assets"]["fridge-abc"]["links"][0]["parts"]
    parts *= 9
    with pytest.raises(SceneInvalidError, match="length <= 16"):
        scene_from_json(broken)


@pytest.mark.parametrize(
    "name", ["x - at `$.rooms[7]", "x - at `$.rooms.y`", "x` - at `$.assets[...][...]", "`", ""]
)
def test_unknown_field_with_a_name_like_the_end_of_a_message_is_refused(scene: Scene, name: str) -> None:
    for place in ((), ("robot",), ("rooms", 0)):
        broken = through_text(scene_to_json(scene))
        part = broken
        for key in place:
            part = part[key]
        part[name] = 1
        with pytest.raises(SceneInvalidError, match="unknown field"):
            scene_from_json(broken)


def test_field_of_a_megabyte_is_named_by_its_beginning(scene: Scene) -> None:
    broken = through_text(scene_to_json(scene)) | {"x" * 1_000_000: 1}
    with pytest.raises(SceneInvalidError) as caught:
        scene_from_json(broken)
    assert len(str(caught.value)) < 2_000


def test_wrong_value_among_very_many_entries_is_named_at_once(scene: Scene) -> None:
    broken = through_text(scene_to_json(scene))
    asset = broken["assets"]["apple-red"]
    asset["abilities"] = {f"ability {number}": {"a": 1.0} for number in range(60_000)}
    asset["abilities"]["ability 59998"] = {"a": "hot"}
    began_s = time.process_time()
    with pytest.raises(SceneInvalidError, match=r"abilities\['ability 59998'\]\['a'\]: found 'hot'"):
        scene_from_json(broken)
    assert time.process_time() - began_s < 5.0


def test_every_missing_key_is_named(scene: Scene) -> None:
    whole = scene_to_json(scene)
    for key in whole:
        broken = copy.deepcopy(whole)
        del broken[key]
        with pytest.raises(SceneInvalidError, match=f"missing required field `{key}`"):
            scene_from_json(broken)


def test_goal_about_an_object_outside_the_table_is_refused(task: Task) -> None:
    value = task_to_json(task) | {"table": ["apple_1"]}
    with pytest.raises(SceneInvalidError, match="fridge_1"):
        task_from_json(value)


def test_table_that_names_an_object_twice_is_refused(task: Task) -> None:
    with pytest.raises(SceneInvalidError, match="twice"):
        task_from_json(task_to_json(task) | {"table": ["fridge_1", "fridge_1"]})


NO_ROWS = Tables(TableWriter().arrays())
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12,
)


@given(json_values)
def test_any_json_value_decodes_or_raises_scene_invalid_error(value: Any) -> None:
    for read in (scene_from_json, task_from_json, asset_from_json, partial(poses_from_json, tables=NO_ROWS)):
        with pytest.raises(SceneInvalidError):
            read(value)


@given(st.data())
def test_scene_with_one_replaced_value_decodes_or_raises_scene_invalid_error(data: st.DataObject) -> None:
    value = through_text(SCENE_JSON)
    place: Any = value
    while isinstance(place, dict | list) and place:
        key = data.draw(st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place))))
        if not isinstance(place[key], dict | list) or data.draw(st.booleans()):
            place[key] = data.draw(json_values)
            break
        place = place[key]
    with contextlib.suppress(SceneInvalidError):
        scene_from_json(value)


SCENE_JSON: dict[str, Any] = {
    "scene_id": "s",
    "base": "s",
    "seed": 1,
    "rooms": [{"name": "r_0", "type": "r", "low_m": [0.0, 0.0], "high_m": [1.0, 1.0]}],
    "walls": [{"shape": "box", "pose": [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], "size_m": [1.0, 0.1, 2.0]}],
    "doorways": [],
    "objects": [
        {
            "name": "a_1",
            "asset_id": "a-x",
            "room": "r_0",
            "pose": [0.5, 0.5, 0.1, 0.0, 0.0, 0.0, 1.0],
            "fixed": False,
            "joints": [],
            "host": "",
            "relation": "",
            "states": [],
        }
    ],
    "assets": {
        "a-x": {
            "asset_id": "a-x",
            "category": "a",
            "synset": "a.n.01",
            "size_m": [0.1, 0.1, 0.1],
            "mass_kg": 1.0,
            "links": [
                {
                    "name": "base",
                    "parts": [
                        {
                            "shape": "box",
                            "pose": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
                            "size_m": [0.1, 0.1, 0.1],
                        }
                    ],
                }
            ],
            "supports": [],
            "interiors": [],
            "abilities": {},
        }
    },
    "robot": {"x_m": 0.2, "y_m": 0.2, "yaw": 0.0, "room": "r_0"},
    "left_out": [],
}


def test_decoding_survives_garbage_collections() -> None:
    """msgspec 0.22 crashes during a collection if a record joins a fixed tuple and a bounded integer in one union."""
    script = (
        "import gc; gc.set_threshold(1)\n"
        "from tests.fakes.scenes import kitchen_scene\n"
        "from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle\n"
        "from embomatrix.world.dataset import TaskRecordJson\n"
        "import msgspec\n"
        "decode_bundle(encode_bundle(Bundle(kitchen_scene(), {})))\n"
        "msgspec.json.Decoder(TaskRecordJson)\n"
        "gc.collect()\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


def test_error_in_a_mapping_names_the_key(scene: Scene) -> None:
    broken = through_text(scene_to_json(scene))
    broken["assets"]["fridge-abc"]["mass_kg"] = "heavy"
    with pytest.raises(SceneInvalidError) as caught:
        scene_from_json(broken)
    assert caught.value.field == "scene.assets['fridge-abc'].mass_kg"
    assert str(caught.value) == (
        "scene.assets['fridge-abc'].mass_kg: found 'heavy': expected `float`, got `str`"
    )
