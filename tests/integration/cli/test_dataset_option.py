"""Every command takes its dataset as `--dataset`, and the same variable names it where the option is missing."""

import importlib.metadata
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from tests.fakes.datasets import write_kitchen_dataset

from embomatrix.factory.evaluate.scripts import held_out_of
from embomatrix.starter.options import DATASET_VARIABLE

MEASURED = {
    *("bench engine", "bench cluster", "bench trainer", "bench operations", "bench adversary"),
    *("bench all", "bench fidelity", "factory evaluate"),
}
"""Commands with a fixed input, so that figures can be compared: the variable does not change it."""
BY_FUNCTION = {"bench traffic", "eval"}
"""Commands that read the variable themselves, because it matters only beside another option."""
READERS = {
    *("demo", "train", "imitate", "play", "manager serve", "bench sample", "bench workload"),
    *("experiment learning", "experiment times", "experiment compare"),
    *("factory list", "factory inspect", "factory pictures", "factory verify", "factory audit"),
    *("factory difficulty", "factory search", "factory conversations", "factory prompts", "factory export"),
}


def commands() -> Iterator[tuple[str, Any]]:
    """Yield every command with its name."""
    for point in importlib.metadata.entry_points(group="embomatrix.commands"):
        loaded = point.load()
        app = loaded if isinstance(loaded, typer.Typer) else typer.Typer()
        if app is not loaded:
            app.command()(loaded)
        yield from _within(point.name, typer.main.get_command(app))


def _within(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    inner = getattr(command, "commands", {})
    if not inner:
        yield name, command
    for word, each in inner.items():
        yield from _within(f"{name} {word}", each)


def test_every_command_that_takes_a_dataset_reads_the_variable_or_has_a_fixed_input() -> None:
    options = {
        name: option
        for name, command in commands()
        for option in command.params
        if "--dataset" in option.opts
    }
    assert set(options) == READERS | MEASURED | BY_FUNCTION
    assert {name for name, option in options.items() if option.envvar} == READERS
    assert {options[name].envvar for name in READERS} == {DATASET_VARIABLE}
    assert all(DATASET_VARIABLE in options[name].help for name in BY_FUNCTION)


def test_no_command_but_merge_takes_a_dataset_as_an_argument() -> None:
    found = {
        name
        for name, command in commands()
        for each in command.params
        if each.param_type_name == "argument" and "dataset" in f"{each.name} {each.help}".lower()
    }
    assert found == {"factory merge"}


def run(line: str, **variables: str) -> subprocess.CompletedProcess[str]:
    arguments = [sys.executable, "-m", "embomatrix.cli", *shlex.split(line)]
    return subprocess.run(arguments, capture_output=True, text=True, timeout=120, env=_environment(variables))


def _environment(variables: dict[str, str]) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name != DATASET_VARIABLE}
    return {**kept, "COLUMNS": "160", **variables}


@pytest.mark.parametrize("name", ["list", "pictures", "verify", "audit", "difficulty", "prompts", "export"])
def test_a_dataset_given_as_an_argument_is_refused_with_the_new_form(name: str, tmp_path: Path) -> None:
    out = f" --out {tmp_path / 'new.jsonl'}" if name in ("prompts", "export") else ""
    done = run(f"factory {name} 'my tasks'{out}")
    assert done.returncode == 2
    assert done.stderr == (
        f"embomatrix factory {name}: 'my tasks' is not an option: give the dataset as --dataset 'my tasks'\n"
    )
    assert not list(tmp_path.iterdir())


def test_variable_names_the_dataset_and_the_option_comes_before_it(tmp_path: Path) -> None:
    for line in (
        "factory list",
        "factory verify",
        "factory inspect TASK",
        f"train --out {tmp_path / 'run'}",
        "eval --baseline oracle",
    ):
        found = run(line, **{DATASET_VARIABLE: "/no/such"})
        assert (found.returncode, "/no/such" in found.stderr) == (2, True), line
        found = run(f"{line} --dataset /nor/that", **{DATASET_VARIABLE: "/no/such"})
        assert (found.returncode, "/nor/that" in found.stderr) == (2, True), line


@pytest.mark.parametrize(("name", "tasks"), [("internal-verified-2", "100"), ("search", "1,663")])
def test_commands_that_change_no_dataset_take_one_that_ships_by_its_name(name: str, tasks: str) -> None:
    done = run(f"factory list --dataset {name} --limit 1")
    assert done.returncode == 0
    assert f"tasks 1 to 1 of {tasks}; --page 2 shows more" in done.stdout


def test_other_training_tasks_are_taken_by_name_too(tmp_path: Path) -> None:
    _, learned, _ = held_out_of(write_kitchen_dataset(tmp_path), Path("search"))
    assert len(learned.train) == 1512
