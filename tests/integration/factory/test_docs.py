"""docs/tasks.md names every refusal, field and option, and its problem can be bound."""

import re
from dataclasses import replace
from pathlib import Path

from tests.fakes.scenes import kitchen_scene
from typer.testing import CliRunner

from embomatrix.factory.admission import RefusalReason
from embomatrix.factory.commands import app as cli
from embomatrix.factory.task_import.reach import HELD
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.factory.task_import.task import ImportedTask, import_problem
from embomatrix.skills.parse import plan_to_json
from embomatrix.skills.syntax import Skill, SkillCall
from embomatrix.world.codec_task import task_to_json
from embomatrix.world.dataset import SPLITS, Dataset, TaskRecord, record_to_json
from embomatrix.world.difficulty import Difficulty
from embomatrix.world.intent import IntentClause
from embomatrix.world.task import MAX_TABLE, Profile, TaskCategory

PAGE = (Path(__file__).parents[3] / "docs" / "tasks.md").read_text(encoding="utf-8")


def rows(first_heading: str) -> dict[str, str]:
    """Return the table whose first column has this heading: row names mapped to the next cell."""
    found = re.search(rf"^\| {first_heading} \|.*\n\| ---.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert found, f"docs/tasks.md has no table of {first_heading}"
    cells = [line.strip("|").split(" | ") for line in found[1].splitlines()]
    return {name.strip(" `"): value for name, value in cells}


def imported() -> ImportedTask:
    """Return the page's problem, bound to a kitchen."""
    text = re.search(r"```lisp\n(.*?)```", PAGE, re.DOTALL)
    assert text
    outcome = import_problem(SourceText("apple", text[1], "file"), kitchen_scene())
    assert isinstance(outcome, ImportedTask), outcome
    return outcome


def test_every_refusal_is_documented_in_the_order_of_its_check():
    assert list(rows("refusal")) == [*RefusalReason]


def test_fields_of_records_and_tasks_stand_there():
    task = replace(imported().task, profile=Profile.HOUSEHOLD)
    oracle = tuple(plan_to_json((SkillCall(Skill.MOVE, object_index=0),)))
    intent = (IntentClause("hot", ("apple_1",), ("microwave_1",)),)
    difficulty = Difficulty(template=True, nearest=False, greedy=True, steps=1)
    record = TaskRecord(task, "sha256:", "train", oracle, ("kitchen_0",), "", intent, difficulty)
    assert list(rows("field of a record")) == list(record_to_json(record))
    assert list(rows("field of a task")) == list(task_to_json(task))
    assert f"at most {MAX_TABLE} names" in rows("field of a task")["table"]


def test_categories_splits_and_predicates_stand_there():
    for name in (*TaskCategory, *SPLITS):
        assert f"`{name}`" in PAGE
    (predicates,) = re.findall(r"A goal may use `([\w\s]+)`", PAGE)
    assert set(predicates.split()) == HELD


def test_problem_on_the_page_is_imported_by_the_command_on_the_page(tmp_path, monkeypatch):
    assert imported().task.instruction == "Put the apple in the fridge."
    problem = re.search(r"```lisp\n(.*?)```", PAGE, re.DOTALL)
    command = re.search(r"^embomatrix factory (import --bddl .*?) +#", PAGE, re.MULTILINE)
    assert problem
    assert command
    arguments = command[1].split()
    monkeypatch.chdir(tmp_path)
    Path(arguments[arguments.index("--bddl") + 1]).write_text(problem[1], encoding="utf-8")
    done = CliRunner().invoke(cli.app, arguments)
    assert done.exit_code == 0, done.output + done.stderr
    assert len(Dataset.load(arguments[arguments.index("--out") + 1]).records) == 1
