"""Decoders of bundles, datasets, scene and asset files, goals and plans."""

from __future__ import annotations

import functools
import json
import random
import zlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from tests.fakes.tiny_scene import tiny_bundle, tiny_task
from tests.fuzz.decoder import (
    Decoder,
    in_file,
    mutate_bytes,
    mutate_json,
    mutate_json_lines,
    mutated,
    text_of,
)

from embomatrix.factory.floorplan.house_file import HouseFileError, read_house
from embomatrix.factory.floorplan.procthor import house_file_of
from embomatrix.factory.importers.model import ModelFileError
from embomatrix.factory.importers.shelf import read_assets
from embomatrix.factory.scenes.scene_file import SceneFileError, read_scene
from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.sources import ProblemSourceError, read_eai, read_file, read_jsonl
from embomatrix.factory.task_import.task_file import read_task_file
from embomatrix.manager.web.floor_plan import floor_plan, moments_of, movable_objects
from embomatrix.rpc.wire.rollout import skill_call_from_proto, skill_call_to_proto
from embomatrix.skills.describe import line, read_line
from embomatrix.skills.parse import (
    PlanError,
    parse_answer,
    parse_plan,
    plan_from_json,
    plan_to_json,
    plan_to_lines,
)
from embomatrix.skills.prompt import Codec, prompt_for, situation_of
from embomatrix.world.bddl import ROOM_TYPES, BddlError, parse_formula, parse_problem, render_problem
from embomatrix.world.bundle import decode_bundle, encode_bundle
from embomatrix.world.bundle_head import HEAD, MAGIC, read_profiles
from embomatrix.world.codec import asset_from_json, asset_to_json, scene_from_json, scene_to_json
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, TaskRecord, record_to_json
from embomatrix.world.evaluate import GoalError, evaluate, objects_of, render, scored_atoms
from embomatrix.world.inflation import BundleError, Inflation, bundle_digest
from embomatrix.world.task import Profile

if TYPE_CHECKING:
    from embomatrix.skills.syntax import Plan
    from embomatrix.world.bundle import Bundle
    from embomatrix.world.goal import Formula
    from embomatrix.world.task import Task


class Nothing:
    """Facts of a world in which nothing holds."""

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        del predicate, args
        return False


def use_goal(goal: Formula, types: Mapping[str, Sequence[str]]) -> None:
    """Use a goal as rollouts do: list its objects and its scored atoms, and evaluate it."""
    objects_of(goal, types)
    for atom in scored_atoms(goal, types):
        render(atom)
    evaluate(goal, Nothing(), types)


def use_task(task: Task) -> None:
    task.instruction.encode()
    use_goal(task.goal, task.types)


def use_plan(plan: Plan) -> None:
    """Use a plan as trainers do: send it, log it, and show it."""
    messages = [skill_call_to_proto(call) for call in plan]
    again = tuple(skill_call_from_proto(type(each).FromString(each.SerializeToString())) for each in messages)
    assert again == plan
    assert plan_from_json(json.loads(json.dumps(plan_to_json(plan))), Profile.HOUSEHOLD) == plan
    plan_to_lines(plan).encode()


# Bundles


def _packed(content: bytes) -> bytes:
    return zlib.compress(content, 1)


def _bundle(content: bytes) -> object:
    """Decode a bundle with this content, as workers and trainers do, and its tasks, as managers do."""
    data = _packed(content)
    bundle = decode_bundle(data)
    _use_bundle(bundle)
    profiles = read_profiles(in_file("scene.bundle", data))
    assert profiles == {task.task_id: task.profile for task in bundle.tasks.values()}
    return bundle


def _use_bundle(bundle: Bundle) -> None:
    assert decode_bundle(encode_bundle(bundle)) == bundle
    floor_plan(bundle.scene)
    for task in bundle.tasks.values():
        use_task(task)
        movable_objects(bundle.scene, task)
        moments_of(bundle.scene, task, ())
        for codec in Codec:
            prompt_for(situation_of(bundle.scene, task), codec)


def _bundle_tasks(content: bytes) -> object:
    return read_profiles(in_file("scene.bundle", _packed(content)))


def _bundle_file(data: bytes) -> object:
    """Decode compressed bytes whole, and as a stream in two portions; both accept the same bytes."""
    inflation = Inflation()
    streamed = None
    try:
        for portion in (data[: len(data) // 2], data[len(data) // 2 :]):
            for _ in inflation.feed(portion):
                pass
        inflation.finish()
    except BundleError as error:
        streamed = error
    bundle = decode_bundle(data, digest=bundle_digest(data))
    assert streamed is None, streamed
    return bundle


@functools.cache
def _content() -> bytes:
    return zlib.decompress(encode_bundle(tiny_bundle()))


def _mutate_content(content: bytes, rng: random.Random) -> bytes:
    """Return a bundle's content with a change in its JSON or in its arrays; lengths and padding fit."""
    if rng.random() < 0.1 or len(content) < HEAD.size or content[:4] != MAGIC:
        return mutate_bytes(content, rng)
    _, version, size = HEAD.unpack_from(content)
    text, arrays = content[HEAD.size : HEAD.size + size], content[HEAD.size + size :]
    if rng.random() < 0.25:
        arrays = mutate_bytes(arrays, rng)
        arrays += bytes(-len(arrays) % 8)
    else:
        try:
            text = json.dumps(mutated(json.loads(text), rng)).encode("utf-8", "surrogatepass")
        except (ValueError, RecursionError):
            text = mutate_bytes(text, rng)
        text += b" " * (-(HEAD.size + len(text)) % 8)
    return HEAD.pack(MAGIC, version, len(text)) + text + arrays


# Datasets, scenes and assets


def _dataset(data: bytes) -> object:
    found = Dataset.load_file(in_file(TASKS_FILE, data))
    for record in found.records:
        use_task(record.task)
        json.dumps(record_to_json(record))
        plan_from_json(list(record.oracle), record.task.profile)
    return found


def record_line() -> bytes:
    task, digest = tiny_task(), "sha256:" + "0" * 64
    oracle = ({"action": "open", "object_index": 1},)
    record = TaskRecord(task, digest, "train", oracle, ("kitchen_0",), "open")
    return json.dumps(record_to_json(record)).encode()


def _scene(data: bytes) -> object:
    scene = read_scene(in_file("scene.json", data))
    assert scene_from_json(json.loads(json.dumps(scene_to_json(scene)))) == scene
    return scene


def _house(data: bytes) -> object:
    house = read_house(in_file("flat.toml", data))
    assert {room.type for room in house.rooms} <= ROOM_TYPES
    assert all(side > 0 for room in house.rooms for side in room.floor_m)
    return house


def _procthor(data: bytes) -> object:
    return house_file_of(in_file("house.json", data), "house")


PROCTHOR = (
    b'{"rooms": [{"id": "room|1", "roomType": "Kitchen", "floorPolygon": [{"x": 0, "z": 0}, {"x": 0, "z": 4}, {"x": 4, "z": 4},'
    b' {"x": 4, "z": 0}]}], "doors": [{"room0": "room|1", "room1": "room|1"}], "windows": [], "objects": [{"id": "Fridge|1|0",'
    b' "position": {"x": 1, "y": 0.5, "z": 1}, "children": []}]}',
)
HOUSES = (
    b'scene = "flat"\ndoors = [{rooms = ["kitchen_0", "outside"], width_m = 1.0}, {rooms = ["bar_0", "kitchen_0"]}]\n'
    b"[rooms.kitchen_0]\nsize_m = [3.5, 3]\nwindows = 2\nfurniture = {fridge = 1, sofa-mnfbbh = 2}\n"
    b"[rooms.bar_0]\nsize_m = [4, 3]\nheight_m = 2.6\n",
    b'scene = "drawn"\ndoors = [{rooms = ["bar_0", "kitchen_0"]}]\n[rooms.kitchen_0]\nrect_m = [0, 0, 4, 3]\n'
    b"[rooms.bar_0]\nrect_m = [4, 0, 8, 3]\n",
)


def _task_file(data: bytes) -> object:
    file = read_task_file(in_file("tidy.toml", data))
    assert parse_problem(file.source.text) == file.problem
    use_goal(file.problem.goal, file.problem.types)
    return file


TASK_FILES = (
    b'instruction = "Put it away."\nscene = "Rs_int"\ngoal = "(and (inside apple_1 fridge_1) (not (open fridge_1)))"\n'
    b'[objects]\napple_1 = "ontop table_1"\ntable_1 = "inroom kitchen_0"\nfridge_1 = ["inroom kitchen", "not open"]\n',
    b'instruction = "Tidy."\ngoal = "(forall (?m - mug.n.04) (ontop ?m floor_1))"\n[objects]\nmug_1 = []\nmug_2 = []\n'
    b'floor_1 = "inroom kitchen"\n',
)


def _assets(data: bytes) -> object:
    (asset,) = read_assets(in_file("shelf/one.asset.json", data).parent).values()
    assert asset_from_json(json.loads(json.dumps(asset_to_json(asset)))) == asset
    return asset


# Goals and plans

OBJECTS = {
    "apple_1": "apple.n.01",
    "apple_2": "apple.n.01",
    "fridge_1": "fridge.n.01",
    "table_1": "table.n.02",
}
TYPES = {"apple.n.01": ("apple_1", "apple_2"), "fridge.n.01": ("fridge_1",), "table.n.02": ("table_1",)}
FORMULAS = (
    b"(and (ontop ?apple_1 ?table_1) (not (open fridge_1)) (inroom apple_2 kitchen_0))",
    b"(forall (?x - apple.n.01) (exists (?y - table.n.02) (or (ontop ?x ?y) (imply (hot ?x) (cooked ?x)))))",
    b"(forn (2) (?x - apple.n.01) (inside ?x fridge_1))",
    b"(fornpairs (1) (?x - apple.n.01) (?y - table.n.02) (nextto ?x ?y))",
    b"(forpairs (?x - apple.n.01) (?y - apple.n.01) (covered ?x stain.n.01))",
)
PROBLEM = b"""(define (problem tidy_0) (:domain omnigibson) ; a comment
 (:objects apple.n.01_1 apple.n.01_2 - apple.n.01 sink.n.01_* - sink.n.01 floor.n.01_1 - floor.n.01)
 (:init (ontop apple.n.01_1 floor.n.01_1) (not (cooked apple.n.01_2))
  (inroom sink.n.01_* kitchen) (inroom floor.n.01_1 kitchen))
 (:goal (and (forall (?apple.n.01 - apple.n.01) (cooked ?apple.n.01)) (inside apple.n.01_1 apple.n.01_2))))
"""


def _formula(data: bytes) -> object:
    goal = parse_formula(text_of(data), OBJECTS)
    assert parse_formula(render(goal), OBJECTS) == goal
    use_goal(goal, TYPES)
    return goal


def _problem(data: bytes) -> object:
    source = read_file(in_file("problem.bddl", data))
    problem = parse_problem(source.text)
    assert parse_problem(render_problem(problem)) == problem
    use_goal(problem.goal, problem.types)
    return read_problem(source)


def _problem_lines(data: bytes) -> object:
    return [read_problem(source) for source in read_jsonl(in_file("problems.jsonl", data))]


def _eai(data: bytes) -> object:
    """Read EAI's tasks from its table of tasks, its table of instructions, and one problem, separated by zero bytes."""
    stats, words, problem = (*data.split(b"\x00", 2), b"", b"")[:3]
    folder = in_file("eai/data/demo_stats.json", stats).parents[1]
    for name, content in (
        ("evaluation/goal_interpretation/resources/data/instructions_by_activity_name.json", words),
        ("evaluation/transition_modeling/resources/pddl_behavior/tidy_0.pddl", problem),
    ):
        in_file(f"eai/{name}", content)
    return [read_problem(source) for source in read_eai(folder)]


def _plan(data: bytes) -> object:
    text = text_of(data)
    found: list[Plan | None] = []
    for profile in Profile:
        try:
            found.append(parse_plan(text, profile))
        except PlanError:
            found.append(None)
    for plan in found:
        if plan is not None:
            use_plan(plan)
            assert parse_plan(plan_to_lines(plan), Profile.HOUSEHOLD) == plan
    return parse_plan(text)


def _answer(data: bytes) -> object:
    text = text_of(data)
    plan, done = parse_answer(text, Profile.HOUSEHOLD)
    if plan:
        use_plan(plan)
        again = f"{plan_to_lines(plan)}\ndone" if done else plan_to_lines(plan)
        assert parse_answer(again, Profile.HOUSEHOLD) == (plan, done)
    return plan, done


ANSWERS = (
    b"move 3\ndone",
    b'I see it. {"action": "open", "object_index": 2}',
    b'```json\n[{"action": "move", "object_index": 3}, {"action": "done"}, {"action": 7}]\n```',
    b'{"action": "done"}',
    b"<think>open 2</think> Done.",
    b'{"action": "move", "object_index"',
)


def _object_line(data: bytes) -> object:
    text = text_of(data)
    found = read_line(text)
    assert read_line(line(found)) == found
    return found


PLANS = (
    b'[{"action": "move", "object_index": 0},'
    b' {"action": "place", "parameters": {"object_index": 3, "relation": "inside"}}]',
    b'I think <x>.</think> {"action_sequence": [{"action": "turn", "yaw": -0.5}]}'
    b' done {"plan": [{"action": "open", "object_index": 2}]}',
    b"1. move 3; place 3 inside\nmove_forward 0.5 1e-3\ngo_to_room kitchen_0\n- heat_object_with_source 1 2",
    b'```json\n[{"action": "go_to_room", "room_name": "kitchen_0"},'
    b' {"action": "slice_object_with_tool", "object_index": 1, "tool_index": 2}]\n```',
    b'[{"action": "go_to_room", "room_name": "\\ud800"}]',
    b"[" * 3_000,
    b'[{"action": "move", "object_index": ' + b"9" * 400 + b"}]",
)


def table() -> dict[str, Decoder]:
    """Return the decoders of this module by name."""
    content = _content()
    scene = json.dumps(scene_to_json(tiny_bundle().scene)).encode()
    assets = [json.dumps(asset_to_json(asset)).encode() for asset in tiny_bundle().scene.assets.values()]
    line = record_line()
    problem = json.dumps({"name": "tidy_0", "bddl": PROBLEM.decode()}).encode()
    eai = b'{"tidy_0": {"task": "tidy", "scene_id": "Rs_int"}}\x00{"tidy": "Tidy the room."}\x00' + PROBLEM
    decode = {"world.records:decode", "world.records:_failing_key.fails"}
    convert = {"world.records:convert", "world.records:_failing_key.fails"}
    arrays = {"world.bundle:_arrays", "world.bundle:_from_content", "world.inflation:Inflation.__init__"}
    odd_arrays = content.replace(b'"stands":["<f8"', b'"stands":["<i4"')
    odd_keys = content.replace(b'"mass_kg":0.2', b'"mass_kg":-.2').replace(b"-.2", b"-2 ")
    return {
        "bundle": Decoder(
            _bundle,
            (BundleError, GoalError),
            lambda: (content, odd_arrays, odd_keys),
            frozenset({*arrays, *decode, "world.bundle_head:read_profiles"}),
            _mutate_content,
        ),
        "tasks of a bundle": Decoder(
            _bundle_tasks,
            (BundleError,),
            lambda: (content,),
            frozenset({"world.bundle_head:read_profiles"}),
            _mutate_content,
        ),
        "bundle file": Decoder(
            _bundle_file,
            (BundleError,),
            lambda: (_packed(content), encode_bundle(tiny_bundle()), zlib.compress(bytes(200_000), 9)),
            frozenset({"world.inflation:Inflation.__init__"}),
            mutate_bytes,
        ),
        "dataset": Decoder(
            _dataset,
            (DatasetError, GoalError, PlanError),
            lambda: (line, line + b"\n\n" + line.replace(b"paper", b"household") + b"\n"),
            frozenset({"world.dataset:_record", *convert} - {"world.records:_failing_key.fails"}),
            mutate_json_lines,
        ),
        "scene file": Decoder(
            _scene,
            (SceneFileError,),
            lambda: (scene,),
            frozenset({"factory.scenes.scene_file:read_scene", "world.records:convert"}),
            mutate_json,
        ),
        "house file": Decoder(
            _house,
            (HouseFileError,),
            lambda: HOUSES,
            frozenset({"factory.toml_files:read_toml", "world.records:convert"}),
            mutate_bytes,
        ),
        "house of ProcTHOR": Decoder(
            _procthor,
            (HouseFileError,),
            lambda: PROCTHOR,
            frozenset({"factory.floorplan.procthor:house_file_of"}),
            mutate_json,
        ),
        "task file": Decoder(
            _task_file,
            (ProblemSourceError, GoalError),
            lambda: TASK_FILES,
            frozenset({"factory.toml_files:read_toml", "world.records:convert"}),
            mutate_bytes,
        ),
        "asset file": Decoder(
            _assets,
            (ModelFileError,),
            lambda: assets,
            frozenset({"factory.importers.shelf:read_assets", "world.records:convert"}),
            mutate_json,
        ),
        "formula": Decoder(_formula, (BddlError, GoalError), lambda: FORMULAS, frozenset(), mutate_bytes),
        "problem": Decoder(
            _problem,
            (BddlError, ProblemSourceError, GoalError),
            lambda: (PROBLEM,),
            frozenset(),
            mutate_bytes,
        ),
        "problem lines": Decoder(
            _problem_lines,
            (BddlError, ProblemSourceError),
            lambda: (problem, problem + b"\n\n" + problem),
            frozenset({"factory.task_import.sources:read_jsonl"}),
            mutate_json_lines,
        ),
        "EAI package": Decoder(
            _eai,
            (BddlError, ProblemSourceError),
            lambda: (eai,),
            frozenset({"factory.task_import.sources:read_eai"}),
            mutate_bytes,
        ),
        "plan": Decoder(
            _plan,
            (PlanError,),
            lambda: PLANS,
            frozenset({"skills.parse:_json_values", "skills.parse:_found_instead"}),
            mutate_bytes,
        ),
        "answer of an episode": Decoder(
            _answer,
            (PlanError,),
            lambda: ANSWERS,
            frozenset({"skills.parse:_json_values", "skills.parse:_found_instead"}),
            mutate_bytes,
        ),
        "line about an object": Decoder(
            _object_line,
            (ValueError,),
            lambda: (b"apple_1: inside fridge_1 in kitchen_0, hot, covered with dust", b"pie_2: not there"),
            frozenset(),
            mutate_bytes,
        ),
    }
