"""Result of an evaluation: figures with their goals in the format of the benchmarks, and the conditions of measurement."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from embomatrix.pages.figures import Figure, figure_from_json, figure_to_json
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

FIGURES_MARK: Final = b'"part": '
"""Part of the first bytes of each file of figures."""


class EvaluationError(Exception):
    """Evaluation that can't be made or read. The message is one sentence with the remedy."""


@dataclass(frozen=True, slots=True)
class EvaluationFigures:
    """Figures of one part with JSON-serialisable ``conditions`` of measurement, and ``notes`` for the page."""

    part: str
    conditions: Mapping[str, Any]
    figures: tuple[Figure, ...]
    notes: tuple[str, ...] = ()

    def figure(self, name: str) -> Figure:
        """Return the figure of this name. Raise KeyError."""
        return {figure.name: figure for figure in self.figures}[name]


def verdict_on(figure: Figure) -> str:
    """Return ``reached`` or ``short``; empty without a goal."""
    if figure.goal is None:
        return ""
    return "reached" if figure.is_reached else "short"


def evaluation_to_json(evaluation: EvaluationFigures) -> dict[str, Any]:
    """Return a JSON-serialisable dict with numbers of six digits."""
    return {
        "part": evaluation.part,
        "conditions": dict(evaluation.conditions),
        "figures": [figure_to_json(figure) for figure in evaluation.figures],
        "notes": list(evaluation.notes),
    }


def write_evaluation(path: Path, evaluation: EvaluationFigures) -> None:
    """Write an evaluation as JSON. Raise OSError."""
    write_whole(path, (json.dumps(evaluation_to_json(evaluation), indent=1) + "\n").encode("ascii"))


def read_evaluation(path: Path) -> EvaluationFigures:
    """Read a file that `write_evaluation` wrote. Raise EvaluationError for any other content."""
    try:
        value = parse_json(path.read_bytes())
        return EvaluationFigures(
            str(value["part"]),
            dict(value["conditions"]),
            tuple(figure_from_json(item) for item in value["figures"]),
            tuple(map(str, value["notes"])),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise EvaluationError(
            f"{path} contains no figures of an evaluation ({error}): expected a file that `embomatrix factory "
            "evaluate`, `import` or `verify` wrote"
        ) from error
