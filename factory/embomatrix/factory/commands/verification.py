"""``embomatrix factory verify``: verify the tasks of a dataset again, in other processes and in stepped physics."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.options import Jobs, processes
from embomatrix.factory.commands.terminal import counter, fail, report_evaluation, say, user_errors
from embomatrix.factory.evaluate.verification import evaluation_of, objections, sampled, verify_again
from embomatrix.host.own_files import prepare_output
from embomatrix.starter.options import DEFAULT_DATASET, DatasetOrName
from embomatrix.starter.shipped import open_dataset

Physical = Annotated[
    bool,
    typer.Option("--physical", help="Also execute the oracle's plans with a robot in stepped physics."),
]
Sample = Annotated[int | None, typer.Option(min=1, help="Number of tasks to sample. Default: all.")]
Figures = Annotated[Path | None, typer.Option("--json", help="File for the figures, for `evaluate --page`.")]


def verify(
    dataset: DatasetOrName = DEFAULT_DATASET,
    physical: Physical = False,
    sample: Sample = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sample.")] = 0,
    jobs: Jobs = None,
    json_file: Figures = None,
) -> None:
    """Judge admitted tasks again, each in two other processes, which must agree to the bit.

    Exit status 1 if a task is not admitted again or two processes disagree.
    """
    prepare_output("factory verify", json_file)
    with user_errors():
        found = open_dataset(dataset)
        records = sampled(found.records, sample, seed)
        if not records:
            fail(f"{dataset} contains no task: name a dataset with tasks")
        with counter("judgements", 2 * len(records)) as count:
            verdicts = verify_again(
                found.folder, records, physical=physical, jobs=processes(jobs), progress=count
            )
    conditions = {"dataset": dataset.name, "tasks": len(verdicts), "seed": seed}
    for line in objections(verdicts):
        say(line)
    report_evaluation(evaluation_of(verdicts, conditions), json_file)
    if any(verdict.cached or not verdict.agrees for verdict in verdicts):
        raise typer.Exit(1)
