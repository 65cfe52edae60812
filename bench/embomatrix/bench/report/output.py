"""Where a bench's outcome goes: a table for a person, a file for a program, one sentence for what can't be measured."""

from __future__ import annotations

import contextlib
import json
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.table import Table

from embomatrix.bench.report.figures import BenchError, is_shared, result_to_json
from embomatrix.pages.figures import shown
from embomatrix.rpc.status import ClusterError
from embomatrix.sim.engine import EngineError
from embomatrix.world.dataset import DatasetError
from embomatrix.world.inflation import BundleError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from embomatrix.bench.report.figures import BenchResult

console = Console()
errors = Console(stderr=True, soft_wrap=True)


def hand_in(result: BenchResult, json_file: Path | None) -> None:
    """Show the table, and write the file when one is asked for."""
    cores, load = result.machine["cores"], result.machine["load_before"]
    table = Table(
        title=f"bench {result.bench} at {result.commit}, {cores} cores, load before {load}",
        title_justify="left",
    )
    table.add_column("figure")
    for heading in ("value", "goal"):
        table.add_column(heading, justify="right")
    table.add_column("")
    table.add_column("n", justify="right")
    for figure in result.figures:
        goal = "" if figure.goal is None else shown(figure.goal)
        table.add_row(figure.name, f"{figure.told} {figure.unit}", goal, figure.verdict, f"{figure.n:,}")
    console.print(table)
    if is_shared(result.machine):
        console.print("The machine was busy before the bench began: the figures are worse than they need be.")
    if json_file is not None:
        write(json_file, json.dumps(result_to_json(result), indent=2, ensure_ascii=False) + "\n")


def write(path: Path, text: str) -> None:
    """Write beside and rename, so that a page with parts written by hand is never half a page."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


@contextlib.contextmanager
def refusals() -> Iterator[None]:
    """One sentence and status 2 for what a person can mend."""
    try:
        yield
    except (BenchError, BundleError, ClusterError, DatasetError, EngineError, OSError) as error:
        errors.print(f"embomatrix bench: {error}", highlight=False, markup=False)
        raise typer.Exit(2) from None
