"""No command overwrites a file that this tool did not write (docs/decisions/0102)."""

import json
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
from PIL import Image
from tests.fakes.scenes import kitchen_scene
from tests.integration.cli.test_dataset_option import commands

from embomatrix.bench.report.figures import RESULT_MARK, BenchResult, result_to_json
from embomatrix.cli.cluster.trace import TRACE_MARK, chrome_trace
from embomatrix.cli.main import main
from embomatrix.factory.metrics.figures import FIGURES_MARK, EvaluationFigures, write_evaluation
from embomatrix.factory.pictures.marked_files import write_picture
from embomatrix.factory.scenes.base_scenes import keep_scenes
from embomatrix.factory.scenes.scene_file import SCENE_MARKS, write_scene
from embomatrix.host.own_files import PAGE_MARK, PICTURE_MARK, is_own
from embomatrix.pages.head import page_head
from embomatrix.world.dataset import DatasetError

TASK = "apple_to_counter"


@dataclass(frozen=True)
class Refusal:
    """A command that would overwrite ``file``. In the line, K stands for a dataset."""

    line: str
    file: str
    text: bytes = b"mine\n"


TASKS = "OUT/tasks.jsonl"
REFUSALS = (
    Refusal("factory starter --out OUT", TASKS),
    Refusal("factory build --out OUT --train 1 --heldout 0 --scene Rs_int", TASKS),
    Refusal("factory generate --out OUT --tasks 1 --scene Rs_int", TASKS),
    Refusal("factory import --bddl one.bddl --scene Rs_int --out OUT", TASKS),
    Refusal("factory import --bddl one.bddl --scene Rs_int --bind-only --report OUT/r.json", "OUT/r.md"),
    Refusal("factory difficulty --dataset K --out OUT --easy-share 0.5", TASKS),
    Refusal("factory difficulty --dataset OUT --out OUT/../OUT --easy-share 0.5", TASKS),
    Refusal("factory search --dataset K --out OUT", TASKS),
    Refusal("factory search --dataset OUT --out OUT/../OUT", TASKS),
    Refusal("factory search --dataset K --out OUT/new --freeze OUT/frozen.json", "OUT/frozen.json"),
    Refusal("factory merge K K --out OUT", "OUT/notes.txt"),
    Refusal("factory corpus --out OUT", "OUT/tasks/notes.txt"),
    Refusal("factory corpus --part 1 --out OUT", "OUT/parts/1/tasks.jsonl"),
    Refusal("factory corpus --check --out OUT", "OUT/parts/1/tasks.jsonl"),
    Refusal("factory corpus --part 2 --packed OUT", "OUT/tasks-2.xz"),
    Refusal("factory corpus --part 2 --freeze OUT/frozen.json", "OUT/frozen.json"),
    Refusal(f"factory inspect {TASK} --dataset K", f"{TASK}.html"),
    Refusal("factory export --dataset K --out OUT/t.jsonl", "OUT/README.md"),
    Refusal("factory conversations --dataset K --out OUT/t.jsonl", "OUT/t.jsonl"),
    Refusal("factory evaluate lies --out OUT", "OUT/lies.json"),
    Refusal("factory lay --scene Rs_int --bddl one.bddl --method random --out OUT", "OUT/plan.png"),
    Refusal("factory assets draw --category apple", "assets.png"),
    Refusal(
        "factory assets import good.obj --category apple --creator me --licence MIT --cut components --out OUT",
        "OUT/apple-yyuiva.asset.json",
    ),
    Refusal("factory try one.toml --out OUT", TASKS),
    Refusal("scene build Rs_int --out OUT", "OUT/Rs_int.json"),
    Refusal("scene import house.json --out OUT/flat.toml", "OUT/flat.toml"),
    Refusal("scene draw --as relations --out OUT", "OUT/relations.png"),
    Refusal("model import-gguf K OUT", "OUT/config.json"),
    Refusal("model release K OUT --command X", "OUT/notes.txt"),
    Refusal("train --dataset K --out OUT", "OUT/report.html"),
    Refusal("train --dataset K --out OUT", "OUT/metrics.jsonl"),
    Refusal("imitate --dataset K --out OUT", "OUT/reference/notes.txt"),
    Refusal("demo --dataset K --out OUT", "OUT/checkpoints/step-000001/state.json"),
    Refusal("eval --baseline random --dataset K --out OUT", "OUT/report.html"),
    Refusal("eval --baseline random --dataset K --out OUT", "OUT/answers.jsonl", b"mine"),
    Refusal("eai install --folder OUT", "OUT/notes.txt"),
    Refusal("worker install --folder OUT", "OUT/embomatrix-worker.service"),
    Refusal("manager init --data-dir access --hand-out viewer:OUT", "OUT/ca.pem"),
    Refusal("experiment compare --dataset K --out OUT --arm grpo:", "OUT/section.md"),
    Refusal("experiment learning --dataset K --out OUT", "OUT/design.json"),
    Refusal("experiment times --dataset K --out OUT", "OUT/section.md"),
    Refusal("bench workload --dataset K --out OUT", TASKS),
    Refusal("bench sample --record K/tasks.jsonl --dataset K --out OUT", "OUT/traffic.jsonl.xz"),
    Refusal("bench fidelity --dataset K --quick --out OUT", "OUT/plans.jsonl"),
    Refusal("bench first-hour --seeds 1 --out OUT", "OUT/seed-0-grpo/notes.txt"),
    Refusal("bench all --out page.md --json-dir OUT", "OUT/engine.json"),
)
NAMED = {
    *("factory prompts", "eai judge", "bench page", "cluster report", "cluster trace"),
}
"""Commands whose output is one file that the user names, or, for `cluster`, one with the name of a run."""


def contents(folder: Path) -> Mapping[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def run(line: str, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["embomatrix", *shlex.split(line)])
    with pytest.raises(SystemExit) as done:
        main()
    return int(done.value.code or 0)


@pytest.mark.parametrize("case", REFUSALS, ids=lambda case: f"{case.line.partition(' --')[0]}: {case.file}")
def test_a_file_of_others_stays(
    case: Refusal,
    kitchen: Path,
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = place / case.file
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(case.text)
    before = contents(place)
    words = [str(kitchen / word[2:]) if word[:2] == "K/" else word for word in shlex.split(case.line)]
    line = shlex.join(str(kitchen) if word == "K" else word for word in words)
    assert run(line, monkeypatch) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "OUT" in message or case.file in message
    assert "another" in message or "new folder" in message, message
    assert file.read_bytes() == case.text
    made = {name for name in contents(place) if not name.startswith(("access/", "home/", "scratch/"))}
    assert made == before.keys(), "nothing else is written"


def test_every_command_that_writes_into_a_folder_is_tested() -> None:
    places = {"--out", "--json-dir", "--folder", "--hand-out"}
    writers = {
        name
        for name, command in commands()
        for each in command.params
        if places & set(each.opts) or (each.param_type_name == "argument" and each.name == "out")
    }
    tested = {name for name, _ in commands() if any(case.line.startswith(f"{name} ") for case in REFUSALS)}
    assert writers - tested == NAMED


REPEATED = (
    "factory starter --out OUT",
    f"factory inspect {TASK} --dataset K --no-picture",
    "factory import --bddl one.bddl --scene Rs_int --bind-only --report OUT/r.json",
    "factory lay --scene Rs_int --bddl one.bddl --out OUT",
    "scene import house.json --out OUT/flat.toml",
    "factory assets draw --category apple",
    "factory assets import good.obj --category apple --creator me --licence MIT --cut components --out OUT",
    "worker install --folder OUT",
    "manager init --data-dir access --hand-out viewer:OUT",
    "eval --baseline random --dataset K --split all --samples 1 --jobs 1 --out OUT",
)


@pytest.mark.parametrize("line", REPEATED, ids=lambda line: line.partition(" --")[0])
def test_the_same_command_may_replace_its_own_files(
    line: str, kitchen: Path, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "OUT").mkdir()
    words = shlex.split(line)
    line = shlex.join(str(kitchen) if word == "K" else word for word in words)
    assert run(line, monkeypatch) in (0, None), capsys.readouterr().err
    assert run(line, monkeypatch) in (0, None), capsys.readouterr().err


def test_files_of_every_kind_bear_their_mark(tmp_path: Path) -> None:
    scene = kitchen_scene()
    write_scene(tmp_path / "scene", scene)
    assert is_own(tmp_path / "scene", *SCENE_MARKS)
    write_picture(tmp_path / "picture", Image.new("RGB", (2, 2)))
    assert is_own(tmp_path / "picture", PICTURE_MARK)
    (tmp_path / "page").write_text(page_head("a page"))
    assert is_own(tmp_path / "page", PAGE_MARK)
    write_evaluation(tmp_path / "figures", EvaluationFigures("lies", {}, ()))
    assert is_own(tmp_path / "figures", FIGURES_MARK)
    (tmp_path / "result").write_text(json.dumps(result_to_json(BenchResult("engine", "", {}, ())), indent=2))
    assert is_own(tmp_path / "result", RESULT_MARK)
    (tmp_path / "trace").write_text(json.dumps(chrome_trace([], (), "a run"), separators=(",", ":")))
    assert is_own(tmp_path / "trace", TRACE_MARK)
    assert not is_own(tmp_path / "trace", PAGE_MARK)
    assert not is_own(tmp_path / "nothing", PAGE_MARK)
    assert not is_own(tmp_path, PAGE_MARK)
    assert not is_own(tmp_path / "page"), "a kind without a mark is never known"


def test_force_replaces_a_file_of_others(kitchen: Path, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for line, name in (
        ("worker install --folder OUT --force", "OUT/embomatrix-worker.service"),
        ("factory assets draw --category apple --force", "assets.png"),
        ("factory starter --out OUT --force", TASKS),
    ):
        file = place / name
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"mine\n")
        assert run(line, monkeypatch) == 0
        assert file.read_bytes() != b"mine\n"


def test_no_two_scenes_of_one_name_are_kept_in_a_dataset(tmp_path: Path) -> None:
    scene = kitchen_scene()
    keep_scenes(tmp_path, [scene])
    keep_scenes(tmp_path, [scene])
    kept = next((tmp_path / "scenes").iterdir())
    kept.write_text("mine")
    with pytest.raises(DatasetError, match="another scene than the one that the dataset needs"):
        keep_scenes(tmp_path, [scene])
    assert kept.read_text() == "mine"
