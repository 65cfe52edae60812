"""``embomatrix factory audit``: hold the instructions of a dataset against its goals, and search for shortcuts."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.options import Jobs, processes
from embomatrix.factory.commands.terminal import counter, fail, report_evaluation, say, user_errors
from embomatrix.factory.evaluate.faithfulness import (
    PolicyAnswers,
    audit_dataset,
    evaluation_of,
    objections,
    read_answers,
)
from embomatrix.factory.evaluate.verification import sampled
from embomatrix.host.own_files import prepare_output
from embomatrix.starter.options import DEFAULT_DATASET, DatasetOrName
from embomatrix.starter.shipped import open_dataset


def audit(
    dataset: DatasetOrName = DEFAULT_DATASET,
    plans: Annotated[int, typer.Option(min=0, help="Plans to try for each task.")] = 200,
    answers: Annotated[
        Path | None,
        typer.Option(help="answers.jsonl of an evaluation: the policy's plans are tried before the others."),
    ] = None,
    sample: Annotated[
        int | None, typer.Option(min=1, help="Number of tasks to sample. Default: all.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sample.")] = 0,
    jobs: Jobs = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="File for the figures, for `evaluate --page`.")
    ] = None,
) -> None:
    """Compare what instructions demand with what goals score, and search for plans that succeed against the instruction.

    Exit status 1 if a task has such a plan, or if its instruction and goal disagree.
    """
    prepare_output("factory audit", json_file)
    with user_errors():
        found = open_dataset(dataset)
        records = sampled(found.records, sample, seed)
        if not records:
            fail(f"{dataset} contains no task: name a dataset with tasks")
        given = read_answers(answers) if answers is not None else PolicyAnswers()
        with counter("tasks", len(records)) as count:
            audits = audit_dataset(
                found.folder, records, plans=plans, answers=given, jobs=processes(jobs), progress=count
            )
    for line in objections(audits):
        say(line)
    conditions = {"dataset": dataset.name, "tasks": len(audits), "seed": seed}
    report_evaluation(evaluation_of(audits, conditions), json_file)
    if any(each.shortcut or each.findings for each in audits):
        raise typer.Exit(1)
