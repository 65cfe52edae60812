"""What an evaluation hands in: figures with their goals, in the form of the benches' files, and how they were measured."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from embomatrix.pages.figures import figure_from_json, figure_to_json

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from embomatrix.pages.figures import Figure


class EvaluationError(Exception):
    """An evaluation can't be made or read. One sentence that names the remedy."""


@dataclass(frozen=True, slots=True)
class EvaluationFigures:
    """Figures of one part. ``conditions`` say what was measured, as plain JSON values; ``notes`` are sentences for the page."""

    part: str
    conditions: Mapping[str, Any]
    figures: tuple[Figure, ...]
    notes: tuple[str, ...] = ()

    def figure(self, name: str) -> Figure:
        """The figure of that name. Raises KeyError."""
        return {figure.name: figure for figure in self.figures}[name]


def evaluation_to_json(evaluation: EvaluationFigures) -> dict[str, Any]:
    """Plain JSON values; numbers with six digits."""
    return {
        "part": evaluation.part,
        "conditions": dict(evaluation.conditions),
        "figures": [figure_to_json(figure) for figure in evaluation.figures],
        "notes": list(evaluation.notes),
    }


def read_evaluation(path: Path) -> EvaluationFigures:
    """What `evaluation_to_json` made, from a file. Raises EvaluationError when it is none."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        return EvaluationFigures(
            str(value["part"]),
            dict(value["conditions"]),
            tuple(figure_from_json(item) for item in value["figures"]),
            tuple(map(str, value["notes"])),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise EvaluationError(
            f"{path} holds no figures of an evaluation ({error}): expected a file that 'embomatrix factory evaluate' "
            "wrote with --json"
        ) from error
