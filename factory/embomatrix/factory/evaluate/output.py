"""What an evaluation shows on the terminal, and writes for the page."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from embomatrix.factory.commands.terminal import mended
from embomatrix.factory.evaluate.figures import evaluation_to_json
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from pathlib import Path

    from embomatrix.factory.evaluate.figures import EvaluationFigures


def hand_in(evaluation: EvaluationFigures, json_file: Path | None) -> None:
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
