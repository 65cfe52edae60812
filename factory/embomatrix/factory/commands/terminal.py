"""How the factory's commands talk: progress with the time that is left, and what a person can mend in one sentence."""

from __future__ import annotations

import contextlib
import json
from typing import TYPE_CHECKING, NoReturn

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from embomatrix.factory.metrics.figures import EvaluationError, evaluation_to_json
from embomatrix.factory.task_import.sources import ProblemSourceError
from embomatrix.llm.values import LlmError
from embomatrix.rpc.status import ClusterError
from embomatrix.sim.engine import EngineMissingError
from embomatrix.world.catalog import CatalogError
from embomatrix.world.dataset import DatasetError
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from embomatrix.factory.metrics.figures import EvaluationFigures


def progress(console: Console) -> Progress:
    """Bars with how much is done, since when, and how long it will take yet."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    )


@contextlib.contextmanager
def mended(out: Path | None = None, kept: str = "") -> Iterator[None]:
    """What a person can mend is one sentence and exit status 2, an interrupt one and 130.

    ``out`` is what is written, ``kept`` what is left in it by an interrupt, a full disk, or others who answer no more.
    """
    try:
        yield
    except (
        CatalogError,
        DatasetError,
        EngineMissingError,
        EvaluationError,
        ProblemSourceError,
    ) as error:
        fail(str(error))
    except (ClusterError, LlmError) as error:
        fail(f"{error}{kept}")
    except OSError as error:
        if out is None:
            raise
        fail(f"{out} can't be written ({error.strerror}): make room, or name another{kept}")
    except KeyboardInterrupt:
        fail(f"interrupted{kept}", status=130)


def fail(sentence: str, status: int = 2) -> NoReturn:
    """The sentence on standard error, and the end of the command."""
    Console(stderr=True).print(
        f"embomatrix factory: {sentence}", highlight=False, markup=False, soft_wrap=True
    )
    raise typer.Exit(status) from None


def report_evaluation(evaluation: EvaluationFigures, json_file: Path | None) -> None:
    """A table of the figures, the notes below it, and all of it in the file where one is given. Ends what can't be written."""
    table = Table("figure", "value", "goal", "", "n")
    for figure in evaluation.figures:
        verdict = "" if figure.goal is None else "reached" if figure.is_reached else "short"
        table.add_row(
            figure.name, f"{figure.value:.3g} {figure.unit}".strip(), figure.bound, verdict, str(figure.n)
        )
    Console().print(table)
    for note in evaluation.notes:
        Console().print(note, highlight=False, markup=False)
    if json_file is not None:
        with mended(json_file):
            write_whole(
                json_file, (json.dumps(evaluation_to_json(evaluation), indent=1) + "\n").encode("ascii")
            )
