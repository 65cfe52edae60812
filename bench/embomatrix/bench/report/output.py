"""Output of a benchmark: a table on the terminal, a JSON file for programs, one sentence for a refusal."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.table import Table

from embomatrix.bench.report.figures import BenchError, BenchResult, is_shared, result_to_json
from embomatrix.host.failure import fail, unwritable
from embomatrix.host.own_files import prepare_output
from embomatrix.pages.figures import shown
from embomatrix.rpc.status import ClusterError
from embomatrix.sim.engine import EngineError
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.world.dataset import DatasetError
from embomatrix.world.inflation import BundleError
from embomatrix.world.whole_file import write_whole

console = Console()
errors = Console(stderr=True, soft_wrap=True)


def hand_in(result: BenchResult, json_file: Path | None) -> None:
    """Print the table, and write the JSON file if requested."""
    cores, load = result.machine["cores"], result.machine["load_before"]
    title = f"{result.bench} at {result.commit}, {cores} cores, load before {load}"
    table = Table(title=title, title_justify="left")
    for heading in ("figure", "value", "goal", "", "n"):
        table.add_column(heading, justify="right" if heading in ("value", "goal", "n") else "left")
    for figure in result.figures:
        goal = "" if figure.goal is None else shown(figure.goal)
        table.add_row(figure.name, f"{figure.formatted} {figure.unit}", goal, figure.verdict, f"{figure.n:,}")
    console.print(table)
    if is_shared(result.machine):
        console.print(
            "The machine was busy before the benchmark began, so times are longer than on an idle one."
        )
    if json_file is not None:
        write(json_file, json.dumps(result_to_json(result), indent=2, ensure_ascii=False) + "\n")


def write(path: Path, text: str) -> None:
    """Write a whole file or nothing. Raise BenchError."""
    try:
        write_whole(path, text.encode("utf-8"))
    except OSError as error:
        raise BenchError(unwritable(path, error)) from error


@contextlib.contextmanager
def refusals(*outputs: Path | None) -> Iterator[None]:
    """Print one sentence and exit with status 2 for errors that the user can fix, at once for unwritable outputs."""
    prepare_output("bench", *outputs)
    try:
        yield
    except (BenchError, BundleError, ClusterError, DatasetError, EngineError, TrainerError, OSError) as error:
        fail("bench", str(error))
