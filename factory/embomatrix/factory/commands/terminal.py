"""Terminal output of the factory's commands: progress bars, user errors and tables of figures."""

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path

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

from embomatrix.factory.layout.agent_interfaces import BriefError
from embomatrix.factory.layout.distribution import DistributionError
from embomatrix.factory.metrics.figures import (
    EvaluationError,
    EvaluationFigures,
    verdict_on,
    write_evaluation,
)
from embomatrix.factory.task_import.sources import ProblemSourceError
from embomatrix.host import failure
from embomatrix.llm.values import LlmError
from embomatrix.rpc.status import ClusterError
from embomatrix.sim.engine import EngineMissingError
from embomatrix.world.bddl import BddlError
from embomatrix.world.catalog import CatalogError
from embomatrix.world.dataset import DatasetError

fail = functools.partial(failure.fail, "factory")
"""Print a sentence on standard error and exit the command."""


def progress(console: Console) -> Progress:
    """Return progress bars with count, elapsed time and remaining time."""
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
def user_errors(out: Path | None = None, kept: str = "") -> Iterator[None]:
    """Print errors that the user can fix as one sentence and exit with status 2; an interrupt exits with 130.

    ``out`` is the output path. ``kept`` is appended after an interrupt, a full disk or a lost connection.
    """
    try:
        yield
    except (
        BddlError,
        BriefError,
        CatalogError,
        DatasetError,
        DistributionError,
        EngineMissingError,
        EvaluationError,
        ProblemSourceError,
    ) as error:
        fail(str(error))
    except (ClusterError, LlmError) as error:
        fail(f"{error}{kept}")
    except OSError as error:
        if out is None and error.filename is None:
            raise
        if out is None:
            fail(f"{error.filename} can't be used ({error.strerror}): name another file or folder")
        fail(f"{out} can't be written ({error.strerror}): free disk space, or name another path{kept}")
    except KeyboardInterrupt:
        fail(f"interrupted{kept}", status=130)


def report_evaluation(evaluation: EvaluationFigures, json_file: Path | None) -> None:
    """Print a table of the figures and their notes, and write them to ``json_file`` if one is given."""
    table = Table("figure", "value", "goal", "", "n")
    for figure in evaluation.figures:
        value = f"{figure.value:.3g} {figure.unit}".strip()
        table.add_row(figure.name, value, figure.bound, verdict_on(figure), str(figure.n))
    Console().print(table)
    for note in evaluation.notes:
        Console().print(note, highlight=False, markup=False)
    if json_file is not None:
        with user_errors(json_file):
            write_evaluation(json_file, evaluation)
