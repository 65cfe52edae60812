"""Situations in which users meet an error message, the object that each message must name, and its remedy.

In command lines, FILES stands for a folder of damaged files, KITCHEN for a dataset of the kitchen scene, NOWHERE for a manager
address without a manager and URL for a chat endpoint that answers HTTP 401.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from tests.fakes.scenes import kitchen_scene
from tests.fakes.small_llama import save_small_llama

from embomatrix.proto.v1 import rollout_service_pb2, types_pb2, worker_service_pb2
from embomatrix.rpc.reward_label import RewardLabel, answer_in
from embomatrix.rpc.trust import Invitation
from embomatrix.rpc.versions import VersionRange, agree
from embomatrix.rpc.wire.outcome import rollout_result_from_proto
from embomatrix.rpc.wire.rollout import batch_from_proto, rollout_from_proto, skill_call_from_proto
from embomatrix.rpc.wire.run import reward_settings_from_proto, run_terms_from_proto
from embomatrix.rpc.wire.session import lease_from_proto, resources_from_proto
from embomatrix.sim.validation import check_scene
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.parse import parse_plan
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.world.bddl import parse_problem
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle
from embomatrix.world.codec import scene_from_json, scene_to_json
from embomatrix.world.geometry import Pose
from embomatrix.world.inflation import BundleLimits

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@dataclass(frozen=True)
class CommandCase:
    """A command that ends with a message."""

    situation: str
    line: str
    names: str
    """Part of the message that names the value or object at fault."""
    remedy: str
    """Part of the message that says what to do or what is expected."""
    stdin: str = ""
    hidden_package: str = ""
    """Package that the command does not find, as if it were not installed."""


@dataclass(frozen=True)
class CallCase:
    """A function call that raises an error with a message."""

    situation: str
    call: Callable[[], object]
    names: str
    remedy: str


@dataclass(frozen=True)
class SkillCase:
    """A skill call that the simulator refuses. Each value of the message is its field's name in capitals."""

    reason: FailureReason
    names: str
    remedy: str

    @property
    def situation(self) -> str:
        return f"skill call fails: {self.reason.value}"


@dataclass(frozen=True)
class RequestCase:
    """A REST request that a manager refuses."""

    situation: str
    method: str
    path: str
    names: str
    remedy: str
    body: str = ""
    token: str = "secret"


BDDL = """(define (problem apple-0)
  (:domain omnigibson)
  (:objects
    apple.n.01_1 - apple.n.01
    countertop.n.01_1 - countertop.n.01
    agent.n.01_1 - agent.n.01)
  (:init
    (inroom countertop.n.01_1 kitchen)
    (ontop apple.n.01_1 countertop.n.01_1))
  (:goal (and (inside apple.n.01_1 countertop.n.01_1))))
"""
_TEXTS = {
    "problem.bddl": BDDL,
    "unclosed.bddl": BDDL.rstrip()[:-1],
    "unicorn.bddl": BDDL.replace("- apple.n.01", "- unicorn.n.01"),
    "undeclared.bddl": BDDL.replace("inside apple", "inside pear"),
    "empty.bddl": "",
    "problems.jsonl": '{"name": "apple-0"}\n',
    "speed.toml": "speed = 3\n",
    "unfinished.toml": "speed =\n",
    "long_plans.toml": "[grpo]\nmax_new = 2000\n",
    "rate.toml": '[grpo]\nlearning_rate = "fast"\n',
    "minibatches.toml": "[grpo]\ntasks_per_step = 4\nminibatches = 8\n",
    "truncate.toml": "[grpo]\ntruncate_ratio = 2.0\n",
    "lora.toml": "[lora]\nrank = 2\n",
    "samples.toml": "samples = 0\n",
    "attic.toml": "cache_mbb = 3\n",
    "still.toml": "heartbeat_s = 0\n",
    "preferences.toml": "[preferences]\nhous = '18:00-08:00'\n",
    "scene.json": '{"rooms": [',
    "on.toml": 'instruction = "i"\ngoal = "(open fridge_1)"\n[objects]\nfridge_1 = "on floor_1"\n',
    "fridge.toml": 'instruction = "i"\ngoal = "(not (open fridge_1))"\n[objects]\nfridge_1 = "inroom kitchen"\n',
    "pear.toml": 'instruction = "i"\ngoal = "(open pear_1)"\n[objects]\nfridge_1 = "inroom kitchen"\n',
    "window.toml": 'scene = "flat"\n[rooms.kitchen_0]\nsize_m = [3, 3]\nwindow = 2\n',
    "doors.toml": 'scene = "flat"\ndoors = [{rooms = ["kitchen_0", "bar_0"]}]\n[rooms.kitchen_0]\nsize_m = [3, 3]\n',
    "empty_scene.json": "{}",
    "mesh.obj": "v 0 0 0\nf 1 2\nhello\n",
    "good.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n",
    "mesh.step": "solid",
    "robot.urdf": "<robot name='r'><link",
    "tree.urdf": "<robot name='r'><link name='a'/><link name='b'/></robot>",
    "answers.jsonl": "hello\n",
    "eai.json": "{}",
    "report.json": "{}",
    "model.gguf": "hello",
    "brief.json": "{}",
    "cassette.jsonl": "hello\n",
    "good_brief.json": '{"scene": "Rs_int"}',
    "ca.pem": "hello",
    "file": "this is a file, not a folder",
    "figures.json": "{}",
}


def write_files(folder: Path, kitchen: Path) -> None:
    """Write the damaged files and datasets that the command lines name."""
    for name, text in _TEXTS.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "binary.bddl").write_bytes(b"\xff\xfe\x00")
    (folder / "empty").mkdir()
    (folder / "units").mkdir()
    (folder / "units" / "embomatrix-worker.service").write_text("[Unit]\n", encoding="utf-8")
    (folder / "run" / "checkpoints" / "step-000001").mkdir(parents=True)
    (folder / "cut_checkpoint").mkdir()
    (folder / "cut_checkpoint" / "state.json").write_text("{", encoding="utf-8")
    for name in ("cut_records", "binary_records", "cut_bundle", "no_bundle"):
        shutil.copytree(kitchen, folder / name)
    (folder / "cut_records" / "tasks.jsonl").write_bytes((kitchen / "tasks.jsonl").read_bytes()[:200])
    (folder / "binary_records" / "tasks.jsonl").write_bytes(b"\xff")
    save_small_llama(load_tasks(kitchen).train, folder / "llama")
    bundle = next((folder / "cut_bundle" / "bundles").iterdir())
    bundle.write_bytes(bundle.read_bytes()[:200])
    next((folder / "no_bundle" / "bundles").iterdir()).unlink()


ASSET = "--category=apple --creator=me --licence=MIT --out=FILES/new"
PLAY = "play apple_to_counter --dataset=KITCHEN --plan=-"

COMMANDS = (
    # Names
    CommandCase("misspelt command", "trian", "'trian'", "did you mean `train`?"),
    CommandCase("unknown command", "sing", "'sing'", "expected one of bench"),
    CommandCase("misspelt option", "train --datset=KITCHEN", "--datset", "--dataset"),
    CommandCase(
        "misspelt task",
        "play apple_to_countr --oracle --dataset=KITCHEN",
        "apple_to_countr",
        "did you mean apple_to_counter?",
    ),
    CommandCase("misspelt scene", "scene show Rs_imt", "Rs_imt", "did you mean Rs_int"),
    CommandCase(
        "misspelt activity",
        "factory import --activity=bringin_water",
        "bringin_water",
        "did you mean bringing_water",
    ),
    CommandCase(
        "unknown agent",
        "factory agent singer --in=FILES/brief.json",
        "singer",
        "expected one of scene-extractor",
    ),
    CommandCase(
        "unknown factory scene",
        "factory build --scene=Rs_imt --out=FILES/new",
        "Rs_imt",
        "did you mean Rs_int",
    ),
    CommandCase(
        "unknown layout method",
        "factory lay --scene=Rs_int --bddl=FILES/problem.bddl --method=magic",
        "magic",
        "is not one of 'tree'",
    ),
    # Options
    CommandCase(
        "neither plan nor oracle",
        "play apple_to_counter --dataset=KITCHEN",
        "--plan FILE",
        "give one of them",
    ),
    CommandCase("no import source", "factory import", "0 sources", "expected exactly one of --bddl FILE"),
    CommandCase(
        "names in a sheet of plans",
        "scene draw Rs_int --as sheet --labels --out=FILES/new",
        "--as sheet",
        "leave out --labels",
    ),
    CommandCase("no scene named", "scene build --out=FILES/new", "no scene", "give a name"),
    CommandCase(
        "scene and --all", "scene build Rs_int --all --out=FILES/new", "Rs_int", "give names or --all"
    ),
    CommandCase(
        "policy of plans in episodes",
        "train --model=core/embomatrix/starter/policy/policy --episodes=seen --dataset=KITCHEN --out=FILES/new",
        "core/embomatrix/starter/policy",
        "leave out episodes.visibility",
    ),
    CommandCase(
        "model server in episodes",
        "train --model=some/model --episodes=seen --sampler-url=http://127.0.0.1:9 --dataset=KITCHEN --out=FILES/new",
        "sampler.url",
        "leave it or episodes.visibility out",
    ),
    CommandCase(
        "memory of episodes",
        "train --plan-memory=tiny --episodes=seen --dataset=KITCHEN",
        "plan of memory",
        "leave out episodes.visibility",
    ),
    CommandCase(
        "rounds of teaching without episodes",
        "train --teacher-rounds=2 --dataset=KITCHEN --out=FILES/new",
        "episodes.teacher_rounds",
        "set episodes.visibility",
    ),
    CommandCase(
        "more rounds of teaching than steps of imitation",
        "train --episodes=seen --teacher-rounds=9 --imitate-steps=9 --dataset=KITCHEN --out=FILES/new",
        "the 9 steps of imitation",
        "lower it",
    ),
    CommandCase("unknown visibility", "train --episodes=half --dataset=KITCHEN", "half", "full"),
    CommandCase("negative minutes", "train --minutes=-1", "--minutes", "greater than or equal to 0"),
    CommandCase("option without number", "train --steps=many", "--steps", "valid integer"),
    CommandCase(
        "dataset without its option",
        "factory verify KITCHEN --jobs=1",
        "KITCHEN",
        "give the dataset as --dataset",
    ),
    CommandCase(
        "dataset of the shipped sample of traffic",
        "bench traffic --dataset=KITCHEN",
        "--dataset",
        "give both, or neither",
    ),
    CommandCase("missing option", "factory export", "'--out'", "Try 'embomatrix factory export --help'"),
    CommandCase(
        "model without endpoint",
        "factory agent scene-extractor --in=FILES/brief.json --llm=http://localhost:1/v1",
        "scene",
        "`--schema` prints",
    ),
    CommandCase(
        "film of unknown type",
        "play apple_to_counter --oracle --dataset=KITCHEN --film=FILES/film.xyz",
        "film.xyz",
        "expected a name that ends in .gif",
    ),
    CommandCase(
        "export to unknown type",
        "factory export --dataset=KITCHEN --out=FILES/tasks.xlsx",
        ".xlsx",
        "expected .jsonl or .parquet",
    ),
    CommandCase(
        "reward without value",
        "train --reward=goal --dataset=KITCHEN --out=FILES/new",
        "'goal'",
        "expected NAME=VALUE",
    ),
    CommandCase(
        "unknown reward",
        "train --reward=gaol=3 --dataset=KITCHEN --out=FILES/new",
        "reward.gaol",
        "correct its name or remove it",
    ),
    CommandCase(
        "negative reward",
        "train --reward=goal=-3 --dataset=KITCHEN --out=FILES/new",
        "goal",
        "expected 0 or more",
    ),
    # Files of others
    CommandCase(
        "another dataset in the place of the shipped one",
        "factory starter --out=KITCHEN",
        "KITCHEN",
        "name another folder with --out, or pass --force",
    ),
    CommandCase(
        "build into another dataset",
        "factory build --scene=Rs_int --train=1 --heldout=0 --out=KITCHEN",
        "KITCHEN",
        "name another folder with --out",
    ),
    CommandCase(
        "selection over its own dataset",
        "factory difficulty --dataset=KITCHEN --out=KITCHEN --easy-share=0.5",
        "KITCHEN",
        "name another folder with --out",
    ),
    CommandCase(
        "conversations in another format",
        "factory conversations --dataset=KITCHEN --out=FILES/talks.xlsx",
        "the suffix of FILES/talks.xlsx is '.xlsx'",
        "expected .jsonl or .parquet",
    ),
    CommandCase(
        "conversations of a word-level policy",
        "factory conversations --dataset=KITCHEN --codec=names --out=FILES/talks.jsonl",
        "the codec `names` is for word-level policies",
        "expected lines or json",
    ),
    CommandCase(
        "searches over their own dataset",
        "factory search --dataset=KITCHEN --out=KITCHEN",
        "KITCHEN",
        "name another folder with --out",
    ),
    CommandCase(
        "evaluation beside a foreign report",
        "eval --baseline=random --dataset=KITCHEN --out=FILES",
        "FILES/report.json",
        "pass another --out",
    ),
    CommandCase(
        "unit of others",
        "worker install --folder=FILES/units",
        "FILES/units/embomatrix-worker.service",
        "pass --force",
    ),
    CommandCase(
        "judge into a folder of others", "eai install --folder=FILES", "FILES", "name another folder"
    ),
    CommandCase(
        "model into a folder of others",
        "model import-gguf FILES/model.gguf FILES",
        "FILES",
        "give a new folder",
    ),
    # Datasets
    CommandCase(
        "missing dataset",
        "play apple_to_counter --oracle --dataset=FILES/nothing",
        "FILES/nothing",
        "get the shipped one with `embomatrix factory starter",
    ),
    CommandCase(
        "cut records",
        "play apple_to_counter --oracle --dataset=FILES/cut_records",
        "FILES/cut_records/tasks.jsonl:1",
        "copy the dataset again",
    ),
    CommandCase(
        "binary records",
        "play apple_to_counter --oracle --dataset=FILES/binary_records",
        "FILES/binary_records",
        "copy the dataset again",
    ),
    CommandCase(
        "cut bundle",
        "play apple_to_counter --oracle --dataset=FILES/cut_bundle",
        "FILES/cut_bundle/bundles",
        "copy the dataset again",
    ),
    CommandCase(
        "missing bundle",
        "play apple_to_counter --oracle --dataset=FILES/no_bundle",
        "FILES/no_bundle/bundles",
        "copy the dataset again",
    ),
    CommandCase(
        "training on a missing dataset",
        "train --dataset=FILES/nothing --out=FILES/new --manager=NOWHERE",
        "FILES/nothing",
        "get the shipped one with `embomatrix factory starter",
    ),
    CommandCase(
        "unreadable plan file",
        "play apple_to_counter --dataset=KITCHEN --plan=FILES/nothing.txt",
        "FILES/nothing.txt",
        "expected a text file",
    ),
    CommandCase(
        "file in place of a dataset",
        "play apple_to_counter --oracle --dataset=FILES/report.json",
        "FILES/report.json is a file",
        "expected the folder of a dataset",
    ),
    CommandCase(
        "word that no category has",
        "factory assets list xyzzy",
        "'xyzzy'",
        "try a shorter or a more general word",
    ),
    CommandCase(
        "file that is no scene",
        "scene draw FILES/mesh.obj --out=FILES/new",
        "FILES/mesh.obj is no floor plan",
        "expected the name of a base scene, or a file that ends in",
    ),
    CommandCase(
        "import over a dataset",
        "factory import --bddl=FILES/problem.bddl --out=KITCHEN",
        "KITCHEN",
        "name another folder with --out",
    ),
    # Plans
    CommandCase(
        "prose instead of a plan", PLAY, "I would rather not.", "expected a JSON array", "I would rather not."
    ),
    CommandCase("empty plan", PLAY, "the text is empty", "expected a JSON array", ""),
    CommandCase(
        "damaged JSON plan",
        PLAY,
        "line 1, column 39",
        "expected a JSON array",
        '[{"action": "move", "object_index": 3}',
    ),
    CommandCase("unknown skill", PLAY, "'dance'", "expected one of move", '[{"action": "dance"}]'),
    CommandCase("unknown index", PLAY, "9999", "indices 0 to 14", "move 9999"),
    CommandCase("unknown room", PLAY, "attic_0", "the rooms are kitchen_0", "go_to_room attic_0"),
    CommandCase("object out of reach", PLAY, "apple_1", "move to it first", "pick_up 10"),
    # BDDL
    CommandCase(
        "missing BDDL file",
        "factory import --bddl=FILES/nothing.bddl --scene=Rs_int",
        "FILES/nothing.bddl",
        "expected a file of BDDL problems",
    ),
    CommandCase(
        "binary BDDL file",
        "factory import --bddl=FILES/binary.bddl --scene=Rs_int",
        "FILES/binary.bddl",
        "expected BDDL problems",
    ),
    CommandCase(
        "empty BDDL file",
        "factory import --bddl=FILES/empty.bddl --scene=Rs_int",
        "empty: line 1",
        "expected '(define (problem NAME) ...)'",
    ),
    CommandCase(
        "unclosed parenthesis",
        "factory import --bddl=FILES/unclosed.bddl --scene=Rs_int",
        "line 1, column 1",
        "add ')'",
    ),
    CommandCase(
        "undeclared object",
        "factory import --bddl=FILES/undeclared.bddl --scene=Rs_int",
        "pear.n.01_1",
        "add it to :objects",
    ),
    CommandCase(
        "unknown object type",
        "factory import --bddl=FILES/unicorn.bddl --scene=Rs_int",
        "unicorn.n.01",
        "did you mean acorn.n.01",
    ),
    CommandCase(
        "JSON lines without BDDL",
        "factory import --jsonl=FILES/problems.jsonl --scene=Rs_int",
        "FILES/problems.jsonl:1",
        "expected an object with 'name' and 'bddl'",
    ),
    CommandCase(
        "no EAI tasks", "factory import --eai=FILES/empty --scene=Rs_int", "FILES/empty", "unpack the wheel"
    ),
    # Scenes, assets, factory
    CommandCase(
        "unknown key of a house file",
        "scene build FILES/window.toml --out=FILES/new",
        "window.toml: rooms.kitchen_0: found the key 'window'",
        "expected only size_m",
    ),
    CommandCase(
        "door of a house file to a room that it lacks",
        "scene draw FILES/doors.toml",
        "doors.toml: doors[0].rooms: found 'bar_0'",
        "expected 'outside' or a room of the file",
    ),
    CommandCase(
        "house file that is no TOML",
        "scene check FILES/unfinished.toml",
        "unfinished.toml is not TOML",
        "correct that line",
    ),
    CommandCase(
        "missing house file",
        "scene show FILES/nothing.toml",
        "nothing.toml",
        "expected a floor plan in TOML",
    ),
    CommandCase(
        "unknown fact in a task file",
        "factory try FILES/on.toml",
        "on.toml: objects.fridge_1: found 'on floor_1'",
        "facts such as 'inroom kitchen'",
    ),
    CommandCase(
        "goal of a task file about an object that it lacks",
        "factory try FILES/pear.toml",
        "object 'pear_1' is not declared",
        "add it to [objects], or correct its name",
    ),
    CommandCase(
        "floor plan in place of a task file",
        "factory try FILES/window.toml",
        "window.toml: its top level: found the key 'rooms'",
        "expected only instruction, goal, objects",
    ),
    CommandCase(
        "missing task file", "factory try FILES/nothing.toml", "nothing.toml", "expected a task in TOML"
    ),
    CommandCase(
        "trial in a folder of another dataset",
        "factory try FILES/fridge.toml --out=KITCHEN",
        "KITCHEN holds a dataset",
        "name another folder with --out",
    ),
    CommandCase(
        "damaged scene file for a build",
        "factory build --scenes=FILES/scene.json --out=FILES/new",
        "FILES/scene.json",
        "expected a file that `embomatrix scene build` wrote",
    ),
    CommandCase(
        "floor plan for an import",
        "factory import --bddl=FILES/problem.bddl --scenes=FILES/window.toml",
        "FILES/window.toml is a floor plan",
        "build it with `embomatrix scene build FILES/window.toml`",
    ),
    CommandCase(
        "damaged scene file",
        "scene show FILES/scene.json",
        "FILES/scene.json",
        "expected a file that `embomatrix scene build` wrote",
    ),
    CommandCase(
        "scene file without rooms",
        "scene show FILES/empty_scene.json",
        "FILES/empty_scene.json",
        "expected a file that `embomatrix scene build` wrote",
    ),
    CommandCase(
        "missing scene file",
        "scene show FILES/nothing.json",
        "FILES/nothing.json",
        "expected a file that `embomatrix scene build` wrote",
    ),
    CommandCase(
        "unknown model format",
        f"factory assets import FILES/mesh.step {ASSET}",
        "'.step'",
        "expected one of .glb",
    ),
    CommandCase(
        "damaged mesh",
        f"factory assets import FILES/mesh.obj {ASSET}",
        "'f 1 2'",
        "expected a vertex such as",
    ),
    CommandCase(
        "damaged URDF",
        f"factory assets import FILES/robot.urdf {ASSET}",
        "FILES/robot.urdf",
        "expected a plain URDF",
    ),
    CommandCase(
        "URDF with two roots",
        f"factory assets import FILES/tree.urdf {ASSET}",
        "'a', 'b'",
        "connect the others with joints",
    ),
    CommandCase(
        "unknown category",
        f"factory assets import FILES/good.obj {ASSET.replace('apple', 'aple')}",
        "'aple'",
        "did you mean",
    ),
    CommandCase(
        "assets folder without assets",
        "scene build Rs_int --assets=FILES/empty --out=FILES/new",
        "FILES/empty",
        "import a model into it first",
    ),
    CommandCase(
        "incomplete brief",
        "factory agent scene-extractor --in=FILES/brief.json",
        "scene",
        "`--schema` prints",
    ),
    CommandCase(
        "missing cassette",
        "factory agent scene-extractor --in=FILES/good_brief.json --cassette=FILES/nothing.jsonl",
        "FILES/nothing.jsonl",
        "record one first",
    ),
    CommandCase(
        "folder of another file",
        "scene build Rs_int --out=FILES/file/out",
        "FILES/file/out",
        "name another path",
    ),
    CommandCase(
        "file to write below a file",
        "factory verify --dataset=KITCHEN --json=FILES/file/figures.json",
        "FILES/file is a file",
        "name another path",
    ),
    CommandCase(
        "file to write is a folder",
        "factory prompts --dataset=KITCHEN --out=FILES/empty",
        "FILES/empty can't be written (Is a directory)",
        "name another path",
    ),
    CommandCase(
        "file to write on a pseudo file system",
        "bench engine --json=/proc/figures.json",
        "/proc/figures.json can't be written",
        "name another path",
    ),
    CommandCase(
        "record of a run below a file",
        "train --dataset=KITCHEN --out=FILES/new --record=FILES/file/record.jsonl",
        "FILES/file is a file",
        "name another path",
    ),
    CommandCase(
        "evaluation into a folder below a file",
        "eval --baseline=random --dataset=KITCHEN --out=FILES/file/out",
        "FILES/file is a file",
        "name another path",
    ),
    CommandCase(
        "evaluation without ledger",
        "factory evaluate admission --dataset KITCHEN",
        "KITCHEN",
        "expected attempts.jsonl",
    ),
    # Trainer
    CommandCase(
        "unknown model",
        "train --model=tinny --dataset=KITCHEN --out=FILES/new",
        "'tinny'",
        "embomatrix model import-gguf",
    ),
    CommandCase(
        "memory of an unknown model",
        "train --plan-memory=tinny --dataset=KITCHEN",
        "'tinny'",
        "embomatrix model import-gguf",
    ),
    CommandCase(
        "unknown setting",
        "train --settings=FILES/speed.toml --dataset=KITCHEN --out=FILES/new",
        "'speed'",
        "correct its name or remove it",
    ),
    CommandCase(
        "plans longer than the model's context",
        "train --settings=FILES/long_plans.toml --dataset=KITCHEN --out=FILES/new",
        "grpo.max_new is 2000",
        "lower one of grpo.max_new and prompt.rows",
    ),
    CommandCase(
        "settings that are not TOML",
        "train --settings=FILES/unfinished.toml --dataset=KITCHEN --out=FILES/new",
        "FILES/unfinished.toml",
        "fix the file",
    ),
    CommandCase(
        "text instead of a number in settings",
        "train --settings=FILES/rate.toml --dataset=KITCHEN --out=FILES/new",
        "grpo.learning_rate",
        "should be a valid number",
    ),
    CommandCase(
        "more minibatches than tasks",
        "train --settings=FILES/minibatches.toml --dataset=KITCHEN --out=FILES/new",
        "expected at most 4, the value of grpo.tasks_per_step",
        "lower it, or raise grpo.tasks_per_step",
    ),
    CommandCase(
        "data-parallel processes on a GPU",
        "train --device=cuda --processes=2 --dataset=KITCHEN --out=FILES/new",
        "expected cpu with processes = 2",
        "set processes to 1, or leave the device out",
    ),
    CommandCase(
        "truncated importance sampling on fresh plans",
        "train --settings=FILES/truncate.toml --dataset=KITCHEN --out=FILES/new",
        "expected none (found 2), because the policy that learns samples the plans itself",
        "leave it out, or set grpo.overlap = 'ahead' or sampler.url",
    ),
    CommandCase(
        "model server without http://",
        "train --sampler-url=localhost:8000 --dataset=KITCHEN --out=FILES/new",
        "'localhost:8000'",
        "expected an address such as http://127.0.0.1:8000",
    ),
    CommandCase(
        "unknown kind of model server",
        "train --sampler-url=http://NOWHERE --sampler-kind=tgi --dataset=KITCHEN --out=FILES/new",
        "'tgi'",
        "should be 'vllm' or 'sglang'",
    ),
    CommandCase(
        "model server with data-parallel processes",
        "train --sampler-url=http://NOWHERE --processes=2 --dataset=KITCHEN --out=FILES/new",
        "setting 'processes': expected 1 with sampler.url",
        "leave one of them out",
    ),
    CommandCase(
        "model server for the word-level policy",
        "train --sampler-url=http://NOWHERE --dataset=KITCHEN --out=FILES/new",
        "sampler.url",
        "leave them out",
    ),
    CommandCase(
        "absent model server",
        "train --model=FILES/llama --settings=FILES/lora.toml --sampler-url=http://NOWHERE --dataset=KITCHEN --out=FILES/new3",
        "the model server http://127.0.0.1:1: it can't be reached",
        "start it first, or correct sampler.url",
    ),
    CommandCase(
        "endpoint that is no model server",
        "train --model=FILES/llama --settings=FILES/lora.toml --sampler-url=URL --dataset=KITCHEN --out=FILES/new3",
        "it answered 501 to /v1/models",
        "check sampler.url, sampler.kind and the server's options",
    ),
    CommandCase(
        "whole model on vLLM",
        "train --model=FILES/llama --sampler-url=http://NOWHERE --dataset=KITCHEN --out=FILES/new3",
        "sampler.kind: vLLM loads adapters while it runs",
        "set lora.rank, or serve the model with SGLang",
    ),
    CommandCase(
        "missing settings file",
        "train --settings=FILES/nothing.toml --dataset=KITCHEN --out=FILES/new",
        "FILES/nothing.toml",
        "expected a TOML file",
    ),
    CommandCase(
        "nothing to resume",
        "train --resume --dataset=KITCHEN --out=FILES/empty",
        "FILES/empty",
        "leave out --resume",
    ),
    CommandCase(
        "output folder of another run",
        "train --dataset=KITCHEN --out=FILES/run",
        "FILES/run",
        "pass --resume to continue it",
    ),
    CommandCase(
        "output folder is a file",
        "train --dataset=KITCHEN --out=FILES/file/out",
        "FILES/file/out",
        "pass another --out",
    ),
    CommandCase(
        "unknown device",
        "train --device=tpu --dataset=KITCHEN --out=FILES/new",
        "'tpu'",
        "expected cpu, or cuda",
    ),
    CommandCase(
        "checkpoint folder without checkpoint",
        "eval --model=FILES/empty --bench=KITCHEN",
        "FILES/empty",
        "expected runs/NAME",
    ),
    CommandCase(
        "manager with a missing dataset",
        "manager serve --dataset=FILES/nothing",
        "there is no dataset in FILES/nothing",
        "get the shipped one with `embomatrix factory starter",
    ),
    CommandCase(
        "damaged checkpoint",
        "eval --model=FILES/cut_checkpoint --bench=KITCHEN",
        "FILES/cut_checkpoint",
        "expected runs/NAME",
    ),
    CommandCase(
        "no manager",
        "train --manager=NOWHERE --dataset=KITCHEN --out=FILES/new2 --imitate-seconds=0 --minutes=0.1",
        "127.0.0.1:1",
        "start one with `embomatrix manager serve`",
    ),
    CommandCase(
        "unknown tracker",
        "train --track=mlflow --dataset=KITCHEN --out=FILES/new",
        "'mlflow'",
        "'tensorboard', 'wandb' or 'trackio'",
    ),
    CommandCase("no subject", "eval --bench=KITCHEN", "--model", "give one of them"),
    CommandCase(
        "endpoint without model name",
        "eval --endpoint=URL --bench=KITCHEN --split=all --out=FILES/new",
        "model has no name",
        "pass --model-name",
    ),
    CommandCase(
        "endpoint refuses the key",
        "eval --endpoint=URL --model-name=m --bench=KITCHEN --split=all --out=FILES/new",
        "401",
        "check its address, its model's name and its key",
    ),
    CommandCase(
        "unknown split",
        "eval --baseline=oracle --bench=KITCHEN --split=test --out=FILES/new",
        "'test'",
        "pass another --split",
    ),
    CommandCase(
        "missing benchmark",
        "eval --baseline=oracle --bench=FILES/nothing --out=FILES/new",
        "FILES/nothing",
        "pass a dataset folder",
    ),
    CommandCase(
        "setting out of range",
        "eval --baseline=oracle --settings=FILES/samples.toml --bench=KITCHEN --out=FILES/new",
        "'samples'",
        "greater than or equal to 1",
    ),
    CommandCase(
        "damaged answers",
        "eval --answers=FILES/answers.jsonl --bench=KITCHEN",
        "FILES/answers.jsonl",
        "expected the answers.jsonl of an evaluation",
    ),
    CommandCase(
        "report of another kind",
        "eval --baseline=oracle --bench=KITCHEN --split=all --beside=FILES/report.json --out=FILES/new",
        "FILES/report.json",
        "expected the report.json of an evaluation",
    ),
    CommandCase(
        "EAI answers of another form",
        "eai judge FILES/eai.json FILES/out.json",
        "FILES/.cache/embomatrix/eai",
        "run `embomatrix eai install`",
    ),
    CommandCase(
        "damaged GGUF file",
        "model import-gguf FILES/model.gguf FILES/new_model",
        "model.gguf",
        "pass another file",
    ),
    # Manager
    CommandCase("port out of range", "manager serve --port=99999", "99999", "less than or equal to 65535"),
    CommandCase(
        "unknown state store",
        "manager serve --port=0 --http-port=0 --state=foo:bar --data-dir=FILES/empty",
        "'foo:bar'",
        "expected memory:, sqlite:PATH or redis:",
    ),
    CommandCase(
        "data folder is a file",
        "manager serve --port=0 --http-port=0 --data-dir=FILES/file/data",
        "FILES/file/data",
        "pass another --data-dir",
    ),
    CommandCase(
        "public address without TLS",
        "manager serve --host=0.0.0.0 --port=0 --http-port=0 --data-dir=FILES/empty",
        "0.0.0.0",
        "run `embomatrix manager init",
    ),
    CommandCase(
        "certificate without key", "manager serve --tls-cert=FILES/ca.pem", "--tls-cert", "pass both, or none"
    ),
    CommandCase(
        "token with a space",
        "manager serve --token='my secret'",
        "--token",
        "expected visible ASCII characters",
    ),
    CommandCase(
        "unknown log level",
        "manager serve --log-level=loud",
        "'loud'",
        "expected debug, info, warning or error",
    ),
    CommandCase(
        "hand-out to an unknown role",
        "manager init --data-dir=FILES/empty --hand-out=king:FILES/new",
        "'king:FILES/new'",
        "expected worker:FOLDER",
    ),
    CommandCase(
        "token of an unknown role", "manager token issue --role=king", "'king'", "expected one of join"
    ),
    CommandCase(
        "token file missing",
        "manager token list --token=@FILES/nothing",
        "@FILES/nothing",
        "name the file that contains the token",
    ),
    # Cluster
    CommandCase("address without port", "status --manager=nowhere", "'nowhere'", "expected HOST:PORT"),
    CommandCase(
        "no manager at the address",
        "cluster workers --manager=NOWHERE",
        "127.0.0.1:1",
        "start one with `embomatrix manager serve`",
    ),
    CommandCase(
        "CA file missing", "status --ca=FILES/nothing.pem", "FILES/nothing.pem", "name the manager's ca.pem"
    ),
    CommandCase("CA file without certificate", "status --ca=FILES/ca.pem", "FILES/ca.pem", "pass the ca.pem"),
    # Worker
    CommandCase(
        "worker with an impossible port",
        "worker run --manager=host:99999",
        "'host:99999'",
        "expected HOST:PORT",
    ),
    CommandCase("niceness out of range", "worker run --nice=50", "--nice 50", "less than or equal to 19"),
    CommandCase("hours as words", "worker run --hours=nights", "'nights'", "expected HH:MM-HH:MM"),
    CommandCase(
        "hours without length", "worker run --hours=08:00-08:00", "'08:00-08:00'", "leave the option out"
    ),
    CommandCase("label without value", "worker run --label=attic", "'attic'", "expected KEY=VALUE"),
    CommandCase(
        "worker name with a space", "worker run --name='my pc'", "'my pc'", "expected up to 64 letters"
    ),
    CommandCase(
        "unknown manager setting",
        "manager serve --config=FILES/attic.toml",
        "cache_mbb",
        "correct its name or remove it",
    ),
    CommandCase(
        "manager setting out of range",
        "manager serve --config=FILES/still.toml",
        "heartbeat_s 0",
        "should be greater than 0",
    ),
    CommandCase(
        "unknown worker setting", "worker run --config=FILES/attic.toml", "cache_mbb", "expected one of ca"
    ),
    CommandCase(
        "unknown worker preference",
        "worker run --config=FILES/preferences.toml",
        "preferences.hous",
        "expected one of calm_s",
    ),
    CommandCase(
        "missing worker settings",
        "worker run --config=FILES/nothing.toml",
        "FILES/nothing.toml",
        "name a TOML file",
    ),
    CommandCase("empty invitation", "worker run --join=''", "--join", "expected TOKEN@HOST:PORT"),
    CommandCase(
        "cache folder is a file",
        "worker run --cache-dir=FILES/file/cache",
        "FILES/file/cache",
        "name another folder with --cache-dir",
    ),
    # Packages
    CommandCase(
        "torch is not installed",
        "train --dataset=KITCHEN --out=FILES/new",
        "'torch'",
        "pip install 'embomatrix[trainer]'",
        hidden_package="torch",
    ),
    CommandCase(
        "uvicorn is not installed",
        "manager serve",
        "'uvicorn'",
        "pip install 'embomatrix[manager]'",
        hidden_package="uvicorn",
    ),
    CommandCase(
        "pybullet is not installed",
        "worker run",
        "pybullet",
        "pip install 'embomatrix[worker]'",
        hidden_package="pybullet",
    ),
    CommandCase(
        "trimesh is not installed",
        "factory build --out=FILES/new",
        "'trimesh'",
        "pip install 'embomatrix[factory]'",
        hidden_package="trimesh",
    ),
    CommandCase(
        "pyarrow is not installed",
        "factory export --dataset=KITCHEN --out=FILES/tasks.parquet",
        "pyarrow",
        "pip install 'embomatrix[export]'",
        hidden_package="pyarrow",
    ),
    CommandCase(
        "Pillow is not installed for a film",
        "play 'open the fridge' --dataset=KITCHEN --oracle --film=FILES/new.gif",
        "'PIL'",
        "pip install 'embomatrix[factory]'",
        hidden_package="PIL",
    ),
    CommandCase(
        "build tools of the wheel are not installed",
        "bench first-hour --seeds=0",
        "without build",
        "pip install -e '.[bench]'",
        hidden_package="build",
    ),
    CommandCase(
        "bddl is not installed",
        "factory import --activity=bringing_water --scene=Rs_int",
        "bddl",
        "pip install bddl==3.6.0",
        hidden_package="bddl",
    ),
)


def _scene_without(**changes: object) -> object:
    return {**scene_to_json(kitchen_scene()), **changes}


def _changed_object(**changes: object) -> object:
    value = scene_to_json(kitchen_scene())
    value["objects"][9] = {**value["objects"][9], **changes}
    return value


def _twins() -> None:
    scene = kitchen_scene()
    check_scene(replace(scene, objects=(*scene.objects, scene.objects[0])))


def _far_away() -> None:
    scene = kitchen_scene()
    far = replace(scene.objects[-1], pose_world_asset=Pose.from_xyz_yaw(1e9, 0.0, 0.0, 0.0))
    check_scene(replace(scene, objects=(*scene.objects[:-1], far)))


def _kitchen_bundle() -> bytes:
    return encode_bundle(Bundle(kitchen_scene(), {}))


def _plan_case(situation: str, text: str, names: str, remedy: str) -> CallCase:
    return CallCase(situation, lambda: parse_plan(text), names, remedy)


MOVE = types_pb2.SkillKind.SKILL_KIND_MOVE
DIGEST = f"sha256:{'0' * 64}"

CALLS = (
    _plan_case("plan of too many steps", "open 1\n" * 65, "65 steps", "expected at most 64; shorten it"),
    _plan_case(
        "plan of too many bytes",
        json.dumps([{"action": "open", "object_index": 1}] * 10_000),
        "390000 bytes",
        "expected at most 65536",
    ),
    _plan_case(
        "yaw that is not a number",
        '[{"action": "turn", "yaw": NaN}]',
        "yaw is nan",
        "expected a finite number",
    ),
    _plan_case(
        "missing argument of a call", '[{"action": "move"}]', "object_index", "expected `move object_index`"
    ),
    _plan_case("too many arguments", "move 3 4", "'move 3 4'", "expected `move object_index`"),
    _plan_case(
        "unknown place relation",
        '[{"action": "place", "object_index": 1, "relation": "behind"}]',
        "'behind'",
        "expected one of ontop",
    ),
    _plan_case(
        "parameters that are a list",
        '[{"action": "move", "parameters": [3]}]',
        "a list",
        "expected an object",
    ),
    _plan_case(
        "step without an action",
        '[{"action": "move", "object_index": 3}, {"skill": "open"}]',
        "step 2",
        "add the name of a skill",
    ),
    _plan_case("empty JSON plan", '{"plan": []}', "the plan is empty", "expected at least one skill call"),
    CallCase(
        "unknown predicate in BDDL",
        lambda: parse_problem(BDDL.replace("(inside", "(near")),
        "'near'",
        "expected one of attached",
    ),
    CallCase("text after the problem", lambda: parse_problem(BDDL + ")"), "')'", "remove it"),
    CallCase("no parenthesis first", lambda: parse_problem("problem"), "'problem'", "expected '('"),
    CallCase(
        "too few arguments in BDDL",
        lambda: parse_problem(BDDL.replace("(inside apple.n.01_1 ", "(inside ")),
        "'inside' is 1",
        "expected 2",
    ),
    CallCase(
        "BDDL without a goal",
        lambda: parse_problem(BDDL.partition("(:goal")[0] + ")"),
        "(:goal ...)",
        "add it to the problem",
    ),
    CallCase(
        "scene without rooms",
        lambda: scene_from_json(_scene_without(rooms=[])),
        "scene.rooms",
        "expected at least one",
    ),
    CallCase(
        "scene with a text as seed",
        lambda: scene_from_json(_scene_without(seed="seven")),
        "scene.seed: found 'seven'",
        "expected `int`",
    ),
    CallCase(
        "object with an unknown asset",
        lambda: scene_from_json(_changed_object(asset_id="unicorn-1")),
        "'unicorn-1'",
        "expected one of the scene's 14 assets",
    ),
    CallCase(
        "object on an unknown host",
        lambda: scene_from_json(_changed_object(host="moon_1")),
        "'moon_1'",
        "expected one that the scene defines",
    ),
    CallCase(
        "object in an unknown relation",
        lambda: scene_from_json(_changed_object(relation="behind")),
        "'behind'",
        "expected one of ontop",
    ),
    CallCase(
        "object with too many joints",
        lambda: scene_from_json(_changed_object(joints=[0.5, 0.5])),
        "scene.objects[9].joints",
        "expected 0 shares of travel",
    ),
    CallCase("two objects of one name", _twins, "'countertop_1'", "rename one"),
    CallCase("object far away", _far_away, "'apple_2'", "expected finite coordinates within 10000 m"),
    CallCase(
        "bundle with another digest",
        lambda: decode_bundle(_kitchen_bundle(), digest=DIGEST),
        "sha256:000000",
        "fetch it again",
    ),
    CallCase(
        "bundle that is cut", lambda: decode_bundle(_kitchen_bundle()[:500]), "sha256:", "fetch it again"
    ),
    CallCase("bundle that is not compressed", lambda: decode_bundle(b"hello"), "sha256:", "fetch it again"),
    CallCase(
        "bundle that is too large",
        lambda: decode_bundle(_kitchen_bundle(), limits=BundleLimits(compressed_bytes=1000)),
        "1,000 bytes",
        "expected at most 1,000",
    ),
    CallCase(
        "protocol of an old worker",
        lambda: agree(VersionRange(2, 2), VersionRange(1, 1), us="this manager", them="worker w1"),
        "worker w1 speaks protocol 1",
        "pip install --upgrade",
    ),
    CallCase(
        "invitation without address", lambda: Invitation.parse("abc"), "--join", "expected TOKEN@HOST:PORT"
    ),
    CallCase("label of another trainer", lambda: RewardLabel.parse("42"), "'42'", "expected a label"),
    CallCase(
        "query without its prompt", lambda: answer_in("move 1", "Tidy up."), "'move 1'", "send both unchanged"
    ),
    CallCase(
        "call of an unknown skill",
        lambda: skill_call_from_proto(types_pb2.SkillCall(skill=99)),
        "99",
        "upgrade this side",
    ),
    CallCase(
        "call without its object",
        lambda: skill_call_from_proto(types_pb2.SkillCall(skill=MOVE)),
        "object_index",
        "move needs one",
    ),
    CallCase(
        "call with a foreign argument",
        lambda: skill_call_from_proto(types_pb2.SkillCall(skill=MOVE, object_index=1, yaw=2.0)),
        "yaw",
        "leave it out",
    ),
    CallCase(
        "rollout without id",
        lambda: rollout_from_proto(types_pb2.Rollout(group_id="g")),
        "rollout_id",
        "expected one",
    ),
    CallCase(
        "rollout twice in a batch",
        lambda: batch_from_proto(
            rollout_service_pb2.ExecuteRequest(
                run_id="r",
                batch_id="b",
                rollouts=[types_pb2.Rollout(rollout_id="r1", group_id="g", bundle_digest=DIGEST, task_id="t")]
                * 2,
            )
        ),
        "'r1'",
        "expected unique ids",
    ),
    CallCase(
        "run with a negative weight",
        lambda: run_terms_from_proto(rollout_service_pb2.OpenRunRequest(name="n", weight=-1.0)),
        "weight: found -1.0",
        "expected 0.001 or more",
    ),
    CallCase(
        "reward that is not finite",
        lambda: reward_settings_from_proto(types_pb2.RewardSettings(goal=float("inf"))),
        "goal: found inf",
        "expected a number between",
    ),
    CallCase(
        "worker without slots",
        lambda: resources_from_proto(types_pb2.Resources()),
        "slots: found 0",
        "expected at least one slot",
    ),
    CallCase(
        "lease without deadline",
        lambda: lease_from_proto(
            worker_service_pb2.Lease(ref=worker_service_pb2.LeaseRef(lease_id="l", lease_epoch=1))
        ),
        "deadline_s: found 0.0",
        "expected a number above 0",
    ),
    CallCase(
        "result without outcome",
        lambda: rollout_result_from_proto(types_pb2.RolloutResult(rollout_id="r", group_id="g")),
        "outcome",
        "expected completed, infra_failure or cancelled",
    ),
)

REQUESTS = (
    RequestCase(
        "unknown worker",
        "POST",
        "workers/w9/drain",
        "'w9'",
        "check its name with `embomatrix cluster workers`",
    ),
    RequestCase("unknown worker's page", "GET", "workers/w9", "'w9'", "it may have left"),
    RequestCase("unknown worker's log", "GET", "workers/w9/log", "'w9'", "it may have left"),
    RequestCase("unknown training", "GET", "training/r9", "'r9'", "those of archived runs"),
    RequestCase("unknown state of runs", "GET", "runs?state=done", "state", "'open', 'closed' or 'all'"),
    RequestCase("unknown run", "GET", "runs/r9", "'r9'", "`embomatrix cluster runs --closed` lists"),
    RequestCase("no token", "GET", "workers", "missing or unknown token", "set EMBOMATRIX_TOKEN", token=""),
    RequestCase(
        "wrong token", "GET", "workers", "missing or unknown token", "set EMBOMATRIX_TOKEN", token="guess"
    ),
    RequestCase("negative offset", "GET", "workers?offset=-1", "offset", "greater than or equal to 0"),
    RequestCase(
        "rewards without queries",
        "POST",
        "rewards",
        "query",
        "expected a JSON object with query",
        '{"query": [], "prompts": [], "labels": []}',
    ),
    RequestCase(
        "rewards that are not JSON",
        "POST",
        "rewards",
        "Invalid JSON",
        "expected a JSON object with query",
        "{",
    ),
    RequestCase(
        "rewards of unequal number",
        "POST",
        "rewards",
        "0 labels",
        "send the same number of each",
        '{"query": ["a"], "prompts": ["a"], "labels": []}',
    ),
    RequestCase(
        "rewards with a foreign label",
        "POST",
        "rewards",
        "'42'",
        "expected a label",
        '{"query": ["a"], "prompts": ["a"], "labels": ["42"]}',
    ),
)

SKILLS = (
    SkillCase(FailureReason.UNKNOWN_INDEX, "INDEX", "the table has indices 0 to LAST"),
    SkillCase(
        FailureReason.NOT_THERE, "TARGET", "use its pieces if it was cut up, or slice the whole object first"
    ),
    SkillCase(FailureReason.UNKNOWN_ROOM, "ROOM", "the rooms are ROOMS"),
    SkillCase(FailureReason.NO_PATH, "TARGET", "clear the way or choose another object"),
    SkillCase(FailureReason.NO_STANDING_POSE, "TARGET", "clear the way or choose another object"),
    SkillCase(FailureReason.BLOCKED, "DISTANCE", "turn, or drive a shorter distance"),
    SkillCase(FailureReason.STEP_TOO_LONG, "DISTANCE", "expected at most LIMIT m"),
    SkillCase(FailureReason.OUT_OF_REACH, "TARGET", "move to it first"),
    SkillCase(FailureReason.TOO_HIGH, "TARGET", "choose a lower object"),
    SkillCase(FailureReason.NO_LINE_OF_APPROACH, "TARGET", "move to it first"),
    SkillCase(FailureReason.HAND_FULL, "HELD", "place it first"),
    SkillCase(FailureReason.HAND_EMPTY, "the hand", "pick something up first"),
    SkillCase(FailureReason.NOT_PORTABLE, "TARGET", "choose a movable object"),
    SkillCase(FailureReason.TOO_HEAVY, "TARGET", "choose a lighter object"),
    SkillCase(FailureReason.TOO_LARGE, "TARGET", "choose a smaller object"),
    SkillCase(FailureReason.SUPPORTS_OTHERS, "TARGET", "take it off first"),
    SkillCase(FailureReason.CONTAINER_CLOSED, "CONTAINER", "open it first"),
    SkillCase(FailureReason.NOT_OPENABLE, "TARGET", "leave the call out"),
    SkillCase(FailureReason.ALREADY_OPEN, "TARGET", "leave the call out"),
    SkillCase(FailureReason.ALREADY_CLOSED, "TARGET", "leave the call out"),
    SkillCase(FailureReason.DOOR_BLOCKED, "TARGET", "clear the way first"),
    SkillCase(FailureReason.OPENED_WHILE_ON, "TARGET", "switch it off before you open it"),
    SkillCase(FailureReason.NOT_TOGGLEABLE, "TARGET", "leave the call out"),
    SkillCase(FailureReason.ALREADY_ON, "TARGET", "leave the call out"),
    SkillCase(FailureReason.ALREADY_OFF, "TARGET", "leave the call out"),
    SkillCase(FailureReason.MUST_BE_CLOSED, "TARGET", "close it first"),
    SkillCase(FailureReason.NO_SURFACE, "TARGET", "choose another object or relation"),
    SkillCase(FailureReason.NO_CAVITY, "TARGET", "choose a larger container"),
    SkillCase(FailureReason.NO_FREE_POSE, "OTHER", "make space or choose another object"),
    SkillCase(FailureReason.PLACES_OUT_OF_REACH, "TARGET", "choose another object"),
    SkillCase(FailureReason.PLACES_BEHIND_DOOR, "TARGET", "choose another object"),
    SkillCase(FailureReason.PLACE_ON_ITSELF, "HELD", "choose another object"),
    SkillCase(FailureReason.NOT_A_HEAT_SOURCE, "SOURCE", "choose an oven, a stove or the like"),
    SkillCase(FailureReason.NOT_A_COLD_SOURCE, "SOURCE", "choose a refrigerator, a freezer or the like"),
    SkillCase(FailureReason.NOT_HEATABLE, "TARGET", "choose another object"),
    SkillCase(FailureReason.NOT_COOKABLE, "TARGET", "choose another object"),
    SkillCase(FailureReason.NOT_FREEZABLE, "TARGET", "choose another object"),
    SkillCase(FailureReason.SOURCE_OFF, "SOURCE", "switch it on first"),
    SkillCase(FailureReason.SOURCE_OPEN, "SOURCE", "close it first"),
    SkillCase(FailureReason.NOT_AT_SOURCE, "TARGET", "place it there first"),
    SkillCase(FailureReason.NOT_HOT_ENOUGH, "TARGET", "choose a hotter source"),
    SkillCase(FailureReason.NOT_COLD_ENOUGH, "TARGET", "choose a colder source"),
    SkillCase(FailureReason.TOOL_NOT_HELD, "SOURCE", "pick it up first"),
    SkillCase(FailureReason.NOT_A_SLICER, "SOURCE", "choose a knife or the like"),
    SkillCase(FailureReason.NOT_SLICEABLE, "TARGET", "choose another object"),
    SkillCase(FailureReason.ALREADY_SLICED, "TARGET", "leave the call out"),
    SkillCase(FailureReason.NOT_A_CLEANER, "SOURCE", "choose a cloth, a brush, a sink or the like"),
    SkillCase(FailureReason.NEEDS_SOAKING, "SOURCE", "soak it first"),
    SkillCase(FailureReason.STAYS_ON, "TARGET", "choose another cleaning tool"),
    SkillCase(FailureReason.GIVES_NO_LIQUID, "SOURCE", "choose a tap or a container of liquid"),
    SkillCase(FailureReason.NOT_SOAKABLE, "TARGET", "choose another object"),
    SkillCase(FailureReason.COLLIDED, "OTHER", "clear the way or choose another route"),
    SkillCase(FailureReason.ARM_BLOCKED, "TARGET", "clear the way first"),
    SkillCase(FailureReason.SLIPPED, "TARGET", "pick it up again"),
    SkillCase(FailureReason.FELL, "TARGET", "choose another place"),
)
