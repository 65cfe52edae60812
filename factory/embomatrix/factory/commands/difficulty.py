"""``embomatrix factory difficulty``: measure the difficulty of each task of a dataset, and select tasks by it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.options import Jobs, ScriptsLearnFrom, processes
from embomatrix.factory.commands.terminal import counter, fail, say, show_table, user_errors
from embomatrix.factory.evaluate.difficulty import (
    level_counts,
    read_policy_shares,
    selected,
    shares_of,
    with_policy,
    with_scripts,
)
from embomatrix.factory.evaluate.scripts import ScriptResults, run_scripts, write_plans
from embomatrix.factory.pipeline.selection import write_selection
from embomatrix.host.own_files import Force
from embomatrix.starter.options import DEFAULT_DATASET, DatasetFolder
from embomatrix.starter.shipped import open_dataset
from embomatrix.world.dataset import SPLITS, TASKS_FILE, Dataset, TaskRecord, encode_records
from embomatrix.world.difficulty import DifficultyLevel
from embomatrix.world.whole_file import write_whole


def difficulty(
    dataset: DatasetFolder = DEFAULT_DATASET,
    training: ScriptsLearnFrom = None,
    policy: Annotated[
        Path | None,
        typer.Option(help="report.json of `embomatrix eval` for a small policy on the dataset's tasks."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for a selection of tasks by the shares of their levels.")
    ] = None,
    easy_share: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Share of easy tasks in the selection.")
    ] = None,
    hard_share: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Share of hard tasks in the selection.")
    ] = None,
    split: Annotated[
        str, typer.Option(help="Select from this split only, train or heldout; the other one is kept whole.")
    ] = "",
    again: Annotated[
        bool, typer.Option("--again", help="Also measure tasks that have a difficulty.")
    ] = False,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """Execute scripts on the tasks and store each task's difficulty in tasks.jsonl.

    easy: the nearest training instruction's demands solve the task. medium: only the script with all training phrases does.
    hard: neither does. With --out, the largest set of tasks with the given shares is written as a dataset of its own.
    """
    if (out is None) != (easy_share is None and hard_share is None):
        fail(
            "--out and the shares belong together: give --out FOLDER with --easy-share, --hard-share or both"
        )
    if split and split not in SPLITS:
        fail(f"unknown split {split!r}: expected {' or '.join(SPLITS)}")
    if out is not None:
        _check_free(out, dataset, force=force)
    with user_errors(out or dataset):
        shares = shares_of(easy_share, hard_share)
        shares_of_policy = read_policy_shares(policy) if policy is not None else {}
        found = Dataset.load(dataset)
        missing = [record for record in found.records if again or record.difficulty is None]
        results = script_results(found, missing, found if training is None else open_dataset(training), jobs)
        records = with_policy(with_scripts(found.records, results), shares_of_policy)
        write_whole(dataset / TASKS_FILE, encode_records(records))
        _print_levels(records)
        if out is not None:
            chosen = selected(records, shares, (split,) if split else SPLITS)
            write_selection(out, found, chosen)
            _print_levels(chosen)
            say(f"{len(chosen)} of {len(records)} tasks: {out}")


def _check_free(out: Path, dataset: Path, *, force: bool) -> None:
    """Exit if a selection would replace the tasks that it is made of, or those of another dataset."""
    if out.resolve() == dataset.resolve():
        fail(
            f"a selection in {out} would replace the tasks that it is made of: name another folder with --out"
        )
    if not force and (out / TASKS_FILE).exists():
        fail(f"{out} holds a dataset already: name another folder with --out, or pass --force to replace it")


def script_results(
    dataset: Dataset, records: Sequence[TaskRecord], training: Dataset, jobs: int | None
) -> ScriptResults:
    """Execute the plans of scripts that learned from ``training`` on these records."""
    if not records:
        return {}
    plans = write_plans(dataset, records, training)
    with counter("tasks", len(records)) as count:
        return run_scripts(dataset, records, plans, jobs=processes(jobs), progress=count)


def _print_levels(records: Sequence[TaskRecord]) -> None:
    """Print the number of tasks of each level by split."""
    counts = level_counts(records)
    show_table(
        ("difficulty", "train", "held out"),
        [(level, *(counted[level] for counted in counts.values())) for level in DifficultyLevel],
    )
