"""Terminal output of the factory's commands: lines, tables, progress bars and user errors."""

import contextlib
import errno
import functools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table
from rich.text import Text

from embomatrix.factory.metrics.figures import (
    EvaluationError,
    EvaluationFigures,
    verdict_on,
    write_evaluation,
)
from embomatrix.factory.scenes.scene_file import SceneFileError
from embomatrix.factory.task_import.sources import ProblemSourceError
from embomatrix.host import failure
from embomatrix.host.printable import printable
from embomatrix.sim.engine import EngineError
from embomatrix.world.bddl import BddlError
from embomatrix.world.catalog import CatalogError
from embomatrix.world.dataset import DatasetError

fail = functools.partial(failure.fail, "")
"""Print a sentence on standard error and exit the command."""
_NO_SPACE: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
USER_ERRORS: Final = (
    BddlError,
    CatalogError,
    DatasetError,
    EngineError,
    EvaluationError,
    ProblemSourceError,
    SceneFileError,
)
"""Errors whose message is a sentence for the user."""


def say(line: object) -> None:
    """Print a line on one line of output however long it is, with control characters escaped."""
    Console(soft_wrap=True).print(printable(str(line), lines=True), highlight=False, markup=False)


def show_table(columns: Iterable[str | Column], rows: Iterable[Iterable[object]], title: str = "") -> None:
    """Print a table of values."""
    table = Table(*columns, title=title or None)
    for row in rows:
        table.add_row(*(Text(printable(str(value))) for value in row))
    Console().print(table)


def progress() -> Progress:
    """Return progress bars with count, elapsed time and remaining time on standard error."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )


@contextlib.contextmanager
def counter(description: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a progress bar. Yield a function that takes the number of finished items."""
    with progress() as bars:
        bar = bars.add_task(description, total=total)
        yield lambda done: bars.update(bar, completed=done)


@contextlib.contextmanager
def user_errors(
    out: Path | None = None, kept: str = "", more: tuple[type[Exception], ...] = ()
) -> Iterator[None]:
    """Print errors that the user can fix as one sentence and exit with status 2; an interrupt exits with 130.

    ``out`` is the output path. ``more`` are further errors of the command. ``kept`` is appended after these, an
    interrupt or a full disk.
    """
    try:
        yield
    except more as error:
        fail(f"{error}{kept}")
    except USER_ERRORS as error:
        fail(str(error))
    except OSError as error:
        if out is None and error.filename is None:
            raise
        if out is None and error.errno not in _NO_SPACE:
            fail(f"{error.filename} can't be used ({error.strerror}): name another file or folder")
        fail(f"{failure.unwritable(out or error.filename, error)}{kept}")
    except KeyboardInterrupt:
        fail(f"interrupted{kept}", status=130)


def report_evaluation(evaluation: EvaluationFigures, json_file: Path | None) -> None:
    """Print a table of the figures and their notes, and write them to ``json_file`` if one is given."""
    show_table(
        ("figure", "value", "goal", "", "n"),
        (
            (each.name, f"{each.value:.3g} {each.unit}".strip(), each.bound, verdict_on(each), each.n)
            for each in evaluation.figures
        ),
    )
    for note in evaluation.notes:
        say(note)
    if json_file is not None:
        with user_errors(json_file):
            write_evaluation(json_file, evaluation)
