"""`embomatrix bench operations`: what an operator waits for, and what an image weighs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from embomatrix.bench.cluster.cli import DATASET, DataSet, Json
from embomatrix.bench.engine.scenes import scenes_of
from embomatrix.bench.operations.compose import compose_at, first_rollout, images
from embomatrix.bench.operations.joining import joining
from embomatrix.bench.operations.viewers import viewing
from embomatrix.bench.report.figures import BenchResult, commit_here, describe_machine
from embomatrix.bench.report.output import errors, hand_in, refusals
from embomatrix.world.dataset import Dataset

if TYPE_CHECKING:
    from embomatrix.pages.figures import Figure


class OperationsPart(StrEnum):
    """What can be measured by itself."""

    IMAGES = "images"
    COMPOSE = "compose"
    JOIN = "join"
    DASHBOARD = "dashboard"


def operations(
    dataset: DataSet = DATASET,
    json_file: Json = None,
    part: Annotated[
        list[OperationsPart] | None,
        typer.Option("--part", help="Only this; may be given again.", show_default=False),
    ] = None,
    checkout: Annotated[Path, typer.Option(help="Folder of the compose file.")] = Path(),
) -> None:
    """Measure `docker compose up` to its first rollout, sizes of images, joining, and what the dashboard costs."""
    parts = part or list(OperationsPart)
    with refusals(), errors.status("operations") as status:
        machine = describe_machine()
        figures: list[Figure] = []

        def on_step(what: str) -> None:
            status.update(f"operations: {what}")

        if OperationsPart.IMAGES in parts:
            compose_at(checkout)
            figures += images()
        if OperationsPart.COMPOSE in parts:
            scene = scenes_of(Dataset.load(dataset), 1)[0]
            figures += first_rollout(compose_at(checkout), scene, on_step)
        if OperationsPart.JOIN in parts:
            figures += joining(on_step)
        if OperationsPart.DASHBOARD in parts:
            figures += viewing(on_step)
        result = BenchResult("operations", commit_here(), machine, tuple(figures))
    hand_in(result, json_file)
