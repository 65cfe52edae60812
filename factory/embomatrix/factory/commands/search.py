"""``embomatrix factory search``: select the tasks of a dataset whose objects must be searched for."""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.options import Jobs, PlacesLearnedFrom, processes
from embomatrix.factory.commands.terminal import counter, fail, say, show_table, user_errors
from embomatrix.factory.evaluate.search import search_tasks, searches
from embomatrix.factory.pipeline.selection import write_selection
from embomatrix.host.own_files import Force, keep_foreign, prepare_output
from embomatrix.starter.options import DEFAULT_DATASET, DatasetOrName
from embomatrix.starter.shipped import FROZEN_MARK, freeze, open_dataset
from embomatrix.world.dataset import SPLITS, TASKS_FILE
from embomatrix.world.task import TaskCategory


def search(
    out: Annotated[Path, typer.Option(help="New folder for the selected tasks.")],
    dataset: DatasetOrName = DEFAULT_DATASET,
    training: PlacesLearnedFrom = None,
    split: Annotated[str, typer.Option(help="Select from this split only, train or heldout.")] = "",
    frozen: Annotated[
        Path | None, typer.Option("--freeze", help="Write the ids of the selected tasks to this file.")
    ] = None,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """Select the tasks that are searches, as a dataset of their own.

    A task is a search if its first look lacks an object that the oracle's plan handles. It is selected if a script that knows
    what to do, but not where unseen objects are, solves it with twice the oracle's calls and 12 more.
    """
    if split and split not in SPLITS:
        fail(f"unknown split {split!r}: expected {' or '.join(SPLITS)}")
    if out.resolve() == dataset.resolve():
        fail(
            f"a selection in {out} would replace the tasks that it is made of: name another folder with --out"
        )
    if not force and (out / TASKS_FILE).exists():
        fail(f"{out} holds a dataset already: name another folder with --out, or pass --force to replace it")
    if frozen is not None:
        keep_foreign("factory search", [frozen], FROZEN_MARK, force=force)
        prepare_output("factory search", frozen)
    with user_errors(out):
        found = open_dataset(dataset)
        records = [record for record in found.records if split in ("", record.split)]
        learned = found if training is None else open_dataset(training)
        with counter("tasks", len(records)) as count:
            results = search_tasks(found, records, learned, jobs=processes(jobs), progress=count)
        chosen = searches(records, results)
        write_selection(out, found, chosen)
        if frozen is not None:
            say(f"frozen: {len(chosen)} tasks, {freeze(chosen, frozen).digest}")
    hidden = sum(result.is_search for result in results.values())
    say(
        f"{hidden} of {len(records)} tasks hide something from the first look; {len(chosen)} are solved: {out}"
    )
    counts = {
        kind: Counter(record.task.category for record in chosen if record.split == kind) for kind in SPLITS
    }
    show_table(
        ("category", "train", "held out"),
        [(category.words, *(counted[category] for counted in counts.values())) for category in TaskCategory],
    )
