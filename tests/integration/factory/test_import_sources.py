"""Problems from files, BEHAVIOR-1K and the paper's sample are bound or refused."""

import json
import re
from collections import Counter
from pathlib import Path

import pytest
from tests.fakes.problems import PROBLEM
from typer.testing import CliRunner, Result

from embomatrix.factory.admission import RefusedError, TaskRefusal
from embomatrix.factory.commands.app import app
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.task_import.batch import bind_first
from embomatrix.factory.task_import.expressible import check_expressible
from embomatrix.factory.task_import.sources import (
    ProblemSourceError,
    SourceText,
    activity_names,
    read_activity,
    read_file,
    read_jsonl,
)
from embomatrix.factory.task_import.task import ImportedTask, import_problem
from embomatrix.world.bddl import parse_problem

SAMPLE = Path(__file__).parents[4] / "shared" / "data" / "embomatrix_tasks_sample.jsonl"

SMALL = """(define (problem Take_the_apple) (:domain omnigibson)
    (:objects apple.n.01_1 - apple.n.01 countertop.n.01_1 - countertop.n.01)
    (:init (ontop apple.n.01_1 countertop.n.01_1) (inroom countertop.n.01_1 kitchen))
    (:goal (not (ontop apple.n.01_1 countertop.n.01_1))))"""


def test_number_of_expressible_goals_matches_the_documentation() -> None:
    pytest.importorskip("bddl", reason="the bddl package is not installed")
    page = " ".join((Path(__file__).parents[3] / "docs" / "tasks.md").read_text().split())
    said = re.search(r"1,016 activities (\d+) pass these checks, of the paper's 400 sample tasks (\d+)", page)
    assert said

    def is_expressible(item: SourceText) -> bool:
        try:
            check_expressible(parse_problem(item.text))
        except RefusedError:
            return False
        return True

    assert sum(is_expressible(read_activity(name)) for name in activity_names()) == int(said[1])
    if SAMPLE.exists():
        assert sum(map(is_expressible, read_jsonl(SAMPLE))) == int(said[2])


def test_unknown_activity_suggests_a_close_name() -> None:
    pytest.importorskip("bddl", reason="the bddl package is not installed")
    with pytest.raises(ProblemSourceError, match="did you mean bringing_water"):
        read_activity("bringin_water")
    assert read_activity("bringing_water").request == "bringing water"
    assert len(activity_names()) >= 1016


def test_unreadable_source_is_rejected_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ProblemSourceError, match="can't be read"):
        read_file(tmp_path / "missing.bddl")
    with pytest.raises(ProblemSourceError, match="can't be read"):
        list(read_jsonl(tmp_path / "missing.jsonl"))
    with (tmp_path / "huge.bddl").open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(ProblemSourceError, match="over 1,048,576 bytes"):
        read_file(tmp_path / "huge.bddl")
    (tmp_path / "bad.jsonl").write_text(json.dumps({"name": "a", "bddl": PROBLEM}) + "\n{}\n")
    with pytest.raises(ProblemSourceError, match=r"bad.jsonl:2: expected an object"):
        list(read_jsonl(tmp_path / "bad.jsonl"))


def test_unparsable_problem_is_refused_and_the_batch_goes_on(tmp_path: Path) -> None:
    rows = [("good", SMALL), ("bad", SMALL[:-20]), ("empty", ""), ("again", SMALL)]
    lines = [json.dumps({"name": name, "bddl": text, "scenes": ["Rs_int"]}) for name, text in rows]
    (tmp_path / "problems.jsonl").write_text("\n".join(lines))
    command = ["import", "--jsonl", str(tmp_path / "problems.jsonl"), "--scene", "Rs_int", "--bind-only"]
    command += ["--reached-by", "household", "--solids", "--jobs", "1"]
    done = CliRunner().invoke(
        app, [*command, "--report", str(tmp_path / "r.json"), "--json", str(tmp_path / "rates.json")]
    )
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "r.json").read_text())
    found = {each["name"]: each["reason"] for each in report["outcomes"]}
    assert found == {"good": "", "bad": "unparsable", "empty": "unparsable", "again": ""}
    sentence = next(each["sentence"] for each in report["outcomes"] if each["name"] == "empty")
    assert "line 1, column 1" in sentence
    assert report["refused"] == {"unparsable": 2}
    assert "* `empty` (unparsable): line 1" in (tmp_path / "r.md").read_text()
    rates = {
        each["name"]: each["value"] for each in json.loads((tmp_path / "rates.json").read_text())["figures"]
    }
    assert rates["import_rate_sample"] == 0.5
    assert rates["import_rate_sample reached by household"] == 0.5


@pytest.mark.parametrize("option", ["--report", "--json"])
def test_output_that_cannot_be_written_is_named_before_any_import(tmp_path: Path, option: str) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    command = ["import", "--activity", "all", "--out", str(tmp_path / "out"), option, str(folder)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2
    assert f"{folder} can't be written (Is a directory)" in re.sub(r"\s+", " ", result.output)


@pytest.mark.skipif(
    not SAMPLE.exists(), reason="the sample of the paper's tasks is not beside the repository"
)
def test_paper_tasks_are_bound_or_refused() -> None:
    bases = [build_base_scene("Rs_int"), build_base_scene("Wainscott_0_int")]
    outcomes = [bind_first(item, bases) for item in list(read_jsonl(SAMPLE))[::8]]
    counts = Counter(item.reason if isinstance(item, TaskRefusal) else "bound" for item in outcomes)
    assert counts["bound"] >= 3
    assert sum(counts.values()) == 50


def test_behavior_1k_activities_are_bound_or_refused() -> None:
    pytest.importorskip("bddl", reason="the bddl package is not installed")
    base = build_base_scene("Wainscott_0_int")
    names = activity_names()[::32]
    outcomes = [import_problem(read_activity(name), base) for name in names]
    bound = [item for item in outcomes if isinstance(item, ImportedTask)]
    assert len(bound) >= 2
    for item in bound:
        assert item.task.source == "behavior-1k"
        assert set(item.task.table) <= set(item.scene.by_name)


def test_import_in_two_processes_gives_the_same_outcomes(tmp_path: Path) -> None:
    jsonl = tmp_path / "problems.jsonl"
    roomy = PROBLEM.replace(
        "(inroom breakfast_table.n.01_1 kitchen)", "(inroom breakfast_table.n.01_1 living_room)"
    )
    problems = {"whole": roomy, "unknown": PROBLEM.replace("apple.n.01", "unicorn.n.01")}
    jsonl.write_text("\n".join(json.dumps({"name": name, "bddl": text}) for name, text in problems.items()))
    written = []
    for jobs in ("1", "2"):
        outcomes = tmp_path / f"{jobs}.jsonl"
        command = ["import", "--jsonl", str(jsonl), "--scene", "Rs_int", "--bind-only", "--jobs", jobs]
        result = CliRunner().invoke(app, [*command, "--outcomes", str(outcomes)])
        assert result.exit_code == 0, result.output
        written.append(outcomes.read_text())
    assert written[0] == written[1]
    assert [json.loads(line)["reason"] for line in written[0].splitlines()[1:]] == ["", "unknown_type"]


def test_solids_option_skips_problems_with_liquids(tmp_path: Path) -> None:
    jsonl, outcomes = tmp_path / "problems.jsonl", tmp_path / "outcomes.jsonl"
    wet = PROBLEM.replace(
        "floor.n.01_1 - floor.n.01\n", "floor.n.01_1 - floor.n.01\n        water.n.06_1 - water.n.06\n"
    )
    jsonl.write_text(
        "\n".join(
            json.dumps({"name": name, "bddl": text})
            for name, text in (("dry", PROBLEM), ("wet", wet), ("arid", PROBLEM))
        )
    )
    command = [
        "import",
        "--jsonl",
        str(jsonl),
        "--scene",
        "Rs_int",
        "--bind-only",
        "--solids",
        "--outcomes",
        str(outcomes),
    ]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert [json.loads(line)["name"] for line in outcomes.read_text().splitlines()[1:]] == ["dry", "arid"]
    jsonl.write_text(json.dumps({"name": "wet", "bddl": wet}))
    refused = CliRunner().invoke(app, command[:-2])
    assert "leave out --solids" in " ".join(refused.output.split())


def test_interrupted_import_resumes_with_the_same_result(tmp_path: Path) -> None:
    unknown = PROBLEM.replace("apple.n.01", "unicorn.n.01")
    jsonl, outcomes = tmp_path / "problems.jsonl", tmp_path / "outcomes.jsonl"
    # two problems may have one name
    lines = [json.dumps({"name": name, "bddl": unknown}) for name in ("a", "b", "b")]
    jsonl.write_text("\n".join(lines))

    def imported(*more: str) -> Result:
        command = ["import", "--jsonl", str(jsonl), "--scene", "Rs_int", "--bind-only"]
        return CliRunner().invoke(app, [*command, "--outcomes", str(outcomes), *more])

    assert "unknown_type" in imported().output
    whole = outcomes.read_text()
    assert len(whole.splitlines()) == 4
    outcomes.write_text("".join(whole.splitlines(keepends=True)[:3])[:-20])
    report = tmp_path / "report.json"
    assert imported("--report", str(report)).exit_code == 0
    assert outcomes.read_text() == whole
    assert [each["name"] for each in json.loads(report.read_text())["outcomes"]] == ["a", "b", "b"]
    assert "other settings (seed 0, now 1)" in " ".join(imported("--seed", "1").output.split())
    jsonl.write_text("\n".join(reversed(lines)))
    other = imported()
    assert other.exit_code == 2
    assert "is about other problems" in " ".join(other.output.split())
