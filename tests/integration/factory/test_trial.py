"""`factory try` checks a task of one's own check by check, and saves one that the oracle solves."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from embomatrix.cli.play import play
from embomatrix.factory.admission import RefusalReason
from embomatrix.factory.commands.app import app
from embomatrix.factory.scenes.base_scenes import SCENES_FOLDER
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.scene_file import write_scene
from embomatrix.factory.task_import.trial import STAGES
from embomatrix.world.dataset import BUNDLES_FOLDER, Dataset

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "tasks.md").read_text(encoding="utf-8")
EXAMPLE = Path("docs/examples/tidy_kitchen.toml")
TIDY = (ROOT / EXAMPLE).read_text(encoding="utf-8")
GOAL = "(and (inside apple_1 fridge_1) (not (open fridge_1)))"
NO_DATASET_REASONS = {
    RefusalReason.NO_ANSWER,
    RefusalReason.UNUSABLE_ANSWER,
    RefusalReason.UNFAITHFUL,
    RefusalReason.SHORTCUT,
    RefusalReason.HIDDEN_OBSTACLE,
}
"""Refusals of drafts and of finished datasets, which a trial does not give."""


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["try", *map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output + result.stderr


def written(folder: Path, text: str, name: str = "tidy.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_task_on_the_page_is_tried_played_and_shown_as_the_page_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    printed = [text for text in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL) if "instruction" in text]
    assert printed == [TIDY]
    monkeypatch.chdir(tmp_path)
    EXAMPLE.parent.mkdir(parents=True)
    EXAMPLE.write_text(TIDY, encoding="utf-8")
    (command,) = re.findall(r"^embomatrix factory try (docs/examples/\S+) +#", PAGE, re.MULTILINE)
    code, output = run(*command.split())
    assert code == 0, output
    (shown,) = re.findall(r"```text\n(✓ text.*?)```", PAGE, re.DOTALL)
    without_seconds = re.compile(r"^[\d.]+ s\.", re.MULTILINE)
    assert without_seconds.sub("", output) == without_seconds.sub("", shown)
    commands = [shlex.split(line) for line in re.findall(r"^  embomatrix (.*)$", output, re.MULTILINE)]
    assert [words[0] for words in commands] == ["play", "play", "factory"]
    player = typer.Typer()
    player.command()(play)
    by_hand = CliRunner().invoke(player, commands[0][1:], input="quit\n")
    assert by_hand.exit_code == 0, by_hand.output
    by_oracle = CliRunner().invoke(player, commands[1][1:])
    assert by_oracle.exit_code == 0, by_oracle.output
    assert "30.90" in by_oracle.output
    inspected = CliRunner().invoke(app, [*commands[2][1:], "--no-picture"])
    assert inspected.exit_code == 0, inspected.output
    assert "Put the apple into the fridge" in Path("tidy_kitchen.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("part", "wrong", "passed", "words"),
    [
        (GOAL, "(dusty fridge_1)", [], "✗ text: .* refused \\(inexpressible\\): .*\\(dusty fridge_1\\)"),
        ("inroom kitchen", "inroom sauna", ["text"], "✗ objects: .* has no 'sauna'"),
        (GOAL, "(inside fridge_1 apple_1)", ["text"], "✗ objects: .* 'apple_1' has no place"),
        (GOAL, "(ontop apple_1 breakfast_table_1)", ["text", "objects"], "✗ start: .*the goal holds at the start"),
        (
            GOAL,
            "(and (ontop apple_1 breakfast_table_1) (open fridge_1) (hot apple_1))",
            ["text", "objects"],
            "✗ start: .*2 of 3 atoms hold",
        ),
        (
            GOAL,
            "(and (open fridge_1) (not (open fridge_1)))",
            ["text", "objects", "start"],
            "✗ plan: .* refused",
        ),
    ],
)  # fmt: skip
def test_refusal_names_the_check_and_what_passed_before(
    tmp_path: Path, part: str, wrong: str, passed: list[str], words: str
) -> None:
    assert part in TIDY
    code, output = run(written(tmp_path, TIDY.replace(part, wrong)), "--out", tmp_path / "tried")
    assert code == 1, output
    assert re.findall(r"^✓ (\w+)", output, re.MULTILINE) == passed
    assert re.search(words, output), output
    assert not (tmp_path / "tried").exists()


def test_substance_that_the_goal_names_is_wiped_off_or_refused(tmp_path: Path) -> None:
    text = """instruction = "Wipe the table."
scene = "Benevolence_1_int"
goal = "(not (covered breakfast_table_1 dust.n.01))"
[objects]
breakfast_table_1 = ["inroom dining_room", "covered dust.n.01"]
rag_1 = "ontop breakfast_table_1"
"""
    code, output = run(written(tmp_path, text), "--out", tmp_path / "tried")
    assert code == 0, output
    assert "clean_object_with_tool breakfast_table_1 rag_1" in output
    filled = text.replace("(not (covered breakfast_table_1 dust.n.01))", "(filled rag_1 water.n.06)")
    code, output = run(written(tmp_path, filled), "--out", tmp_path / "tried")
    assert code == 1, output
    assert "✗ text: " in output


def test_second_trial_replaces_the_first_and_leaves_other_datasets(tmp_path: Path) -> None:
    out = tmp_path / "tried"
    assert run(written(tmp_path, TIDY), "--out", out)[0] == 0
    (first,) = Dataset.load(out).records
    closed = TIDY.replace(', "open"', "").replace("see that the fridge is shut", "shut the fridge")
    assert run(written(tmp_path, closed), "--out", out)[0] == 0
    (second,) = Dataset.load(out).records
    assert first.task.instruction != second.task.instruction
    assert [path.stem for path in (out / BUNDLES_FOLDER).iterdir()] == [
        second.bundle_digest.removeprefix("sha256:")
    ]
    code, output = run(written(tmp_path, TIDY, "other.toml"), "--out", out)
    assert code == 2
    assert "holds a dataset of 1 task that is not an earlier trial of this file" in output
    assert Dataset.load(out).records == (second,)


def test_task_is_tried_in_a_scene_of_ones_own(tmp_path: Path) -> None:
    base = build_base_scene("Benevolence_1_int", seed=2)
    (tmp_path / "scenes").mkdir()
    write_scene(tmp_path / "scenes" / "mine.json", base)
    file = written(tmp_path, TIDY.replace("Benevolence_1_int", "scenes/mine.json"))
    code, output = run(file, "--out", tmp_path / "tried", "--page", tmp_path / "page.html")
    assert code == 0, output
    (record,) = Dataset.load(tmp_path / "tried").records
    scene = Dataset.load(tmp_path / "tried").bundle(record.bundle_digest).scene
    assert (scene.base, scene.seed, scene.rooms) == (base.base, 2, base.rooms)
    assert (tmp_path / "tried" / SCENES_FOLDER / "Benevolence_1_int.json").is_file()
    assert str(tmp_path / "page.html") in output
    assert "<html" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_robot_proves_the_plan_on_request(tmp_path: Path) -> None:
    code, output = run(written(tmp_path, TIDY), "--out", tmp_path / "tried", "--physical")
    assert code == 0, output
    assert "✓ physics: a robot carries the plan out and reaches the goal" in output


def test_every_refusal_of_an_import_belongs_to_a_check() -> None:
    assert {*STAGES} | NO_DATASET_REASONS == {*RefusalReason}
    assert not {*STAGES} & NO_DATASET_REASONS
