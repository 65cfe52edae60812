"""`embomatrix bench trainer`: a step against TRL's, what waiting for simulation costs, how long an evaluation takes."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path  # noqa: TC003  # typer reads the annotations
from typing import Annotated

import typer

from embomatrix.bench.brought import bench_trainer
from embomatrix.bench.cluster.cli import DATASET, DataSet, Json
from embomatrix.bench.report.figures import BenchResult, commit_here, describe_machine
from embomatrix.bench.report.output import errors, hand_in, refusals


class TrainerPart(StrEnum):
    """What can be measured by itself."""

    STEP = "step"
    RUN = "run"
    EVAL = "eval"


def trainer(
    dataset: DataSet = DATASET,
    json_file: Json = None,
    trl: Annotated[
        Path | None,
        typer.Option(
            help="Python of an environment that has TRL: `python3.11 -m venv trl && trl/bin/pip install trl==1.16.0`. Without "
            "it nothing is compared.",
            envvar="EMBOMATRIX_TRL",
        ),
    ] = None,
    part: Annotated[
        list[TrainerPart] | None,
        typer.Option("--part", help="Only this; may be given again.", show_default=False),
    ] = None,
) -> None:
    """Measure a step of GRPO against TRL's, where the time of a short run goes, and an evaluation of stored answers."""
    with refusals(), errors.status("trainer") as status:
        machine = describe_machine()

        def on_step(what: str) -> None:
            status.update(f"trainer: {what}")

        figures = bench_trainer(dataset, trl, part or list(TrainerPart), on_step)
        result = BenchResult("trainer", commit_here(), machine, figures)
    hand_in(result, json_file)
