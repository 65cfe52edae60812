"""`embomatrix eval` in this process: rejected input, and reproducible files."""

import json

import pytest
import typer
from tests.fakes.datasets import write_kitchen_dataset
from typer.testing import CliRunner

from embomatrix.cli.evaluate import evaluate


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("kitchen"))


@pytest.fixture(scope="module")
def measured(kitchen, tmp_path_factory):
    """Folder of an evaluation of random plans."""
    out = tmp_path_factory.mktemp("measured")
    arguments = (f"--bench={kitchen}", "--split=all", "--baseline=random", "--samples=3", "--jobs=1")
    assert run_evaluation(*arguments, f"--out={out}")[0] == 0
    return out


def run_evaluation(*arguments):
    """Return the exit status and all visible output."""
    app = typer.Typer()
    app.command()(evaluate)
    result = CliRunner().invoke(app, [str(item) for item in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, " ".join(result.output.split())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("--model=OUT", "--bench=DATASET"),
            "OUT is not a model: expected runs/NAME, one of its checkpoints",
        ),
        (("--bench=DATASET",), "expected one of --model, --endpoint, --baseline and --answers"),
        (
            ("--baseline=oracle", "--model=tiny"),
            "expected one of --model, --endpoint, --baseline and --answers",
        ),
        (("--baseline=oracle", "--bench=nowhere"), "no benchmark at nowhere: pass a dataset folder"),
        (("--baseline=oracle", "--bench=eai"), "create it with `embomatrix factory import`"),
        (
            ("--endpoint=http://127.0.0.1:1/v1", "--bench=DATASET"),
            "pass --model-name as the endpoint calls it",
        ),
        (
            ("--bench=eai-native", "--baseline=human", "--tasks=3"),
            "is measured as a whole: leave out --split",
        ),
        (
            ("--baseline=oracle", "--bench=DATASET", "--training=DATASET"),
            "--training is for the baselines template and nearest: leave it out",
        ),
        (
            ("--baseline=nearest", "--bench=DATASET", "--training=OUT/none"),
            "there is no dataset in OUT/none",
        ),
        (("--answers=OUT/none",), "none can't be read (No such file or directory)"),
        (("--baseline=oracle", "--settings=OUT/none"), "none can't be read (No such file or directory)"),
    ],
)
def test_invalid_evaluation_is_rejected_with_a_reason(kitchen, tmp_path, arguments, words):
    filled = [item.replace("DATASET", str(kitchen)).replace("OUT", str(tmp_path)) for item in arguments]
    status, text = run_evaluation(*filled, f"--out={tmp_path / 'out'}")
    assert status == 2
    assert words.replace("OUT", str(tmp_path)) in text
    assert not (tmp_path / "out").exists()


def test_unreachable_endpoint_is_reported(kitchen, tmp_path):
    (tmp_path / "settings.toml").write_text("attempts = 1\nsamples = 3\n")
    asked = ("--endpoint=http://127.0.0.1:1/v1", "--model-name=m", f"--settings={tmp_path / 'settings.toml'}")
    status, text = run_evaluation(*asked, f"--bench={kitchen}", "--samples=2", f"--out={tmp_path}")
    assert status == 2
    assert "can't be reached" in text
    assert "0 of 2 answers are kept in" in text


def test_stored_answers_give_identical_files(measured, tmp_path):
    status, text = run_evaluation(f"--answers={measured / 'answers.jsonl'}", f"--out={tmp_path}", "--jobs=2")
    assert status == 0, text
    for name in ("report.json", "report.html", "report.txt"):
        assert (tmp_path / name).read_bytes() == (measured / name).read_bytes()


def test_missing_answers_are_reported(measured, tmp_path):
    lines = (measured / "answers.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "answers.jsonl").write_text("".join(lines[:5]))
    status, text = run_evaluation(f"--answers={tmp_path / 'answers.jsonl'}", "--jobs=1")
    assert status == 0
    assert "8 of 12 answers are missing: the figures leave them out" in text
    assert json.loads((tmp_path / "report.json").read_text())["samples"] == 4


def test_answers_to_other_tasks_are_rejected(measured, kitchen):
    status, text = run_evaluation(
        f"--answers={measured / 'answers.jsonl'}", f"--bench={write_other(measured)}"
    )
    assert status == 2
    assert "answers other tasks than" in text


@pytest.mark.parametrize(
    ("field", "value"),
    [("task_id", "elsewhere"), ("sample", 3), ("sample", -1)],
    ids=["task", "many", "negative"],
)
def test_unexpected_answer_is_rejected(measured, tmp_path, field, value):
    lines = (measured / "answers.jsonl").read_text().splitlines()
    stranger = {**json.loads(lines[1]), field: value}
    (tmp_path / "answers.jsonl").write_text("\n".join([*lines, json.dumps(stranger), ""]))
    status, text = run_evaluation(f"--answers={tmp_path / 'answers.jsonl'}")
    assert status == 2
    assert (
        f"answer to sample {stranger['sample']} of the task '{stranger['task_id']}', which is not part"
        in text
    )


def write_other(folder):
    """Write the same dataset with another oracle plan, which changes the records."""
    other = write_kitchen_dataset(folder / "other")
    lines = [json.loads(line) for line in (other / "tasks.jsonl").read_text().splitlines()]
    lines[0]["task"]["instruction"] = "Do something else."
    (other / "tasks.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return other


def test_other_report_is_added_as_a_row(measured, kitchen, tmp_path):
    arguments = (f"--bench={kitchen}", "--split=all", "--baseline=oracle", "--samples=1", "--jobs=1")
    status, text = run_evaluation(*arguments, f"--beside={measured / 'report.json'}", f"--out={tmp_path}")
    assert status == 0
    assert "oracle 100.0" in text
    assert "random " in text
