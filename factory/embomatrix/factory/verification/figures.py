"""How many tasks of a dataset stand a second look: shares for the page, and what is said against the others."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final

from embomatrix.factory.metrics.figures import EvaluationFigures
from embomatrix.pages.figures import Better, Figure

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from embomatrix.factory.verification.again import VerificationOutcome

GOAL_PERCENT: Final = 100.0
PHYSICAL_GOAL_PERCENT: Final = 97.0


def evaluation_of(
    verdicts: Sequence[VerificationOutcome], conditions: Mapping[str, Any]
) -> EvaluationFigures:
    """Shares in percent of the tasks, and the reasons against plans in physics, the commonest first."""
    physical = [verdict.physical for verdict in verdicts if verdict.in_physics]
    figures = [
        _figure("oracle_cached", [not verdict.cached for verdict in verdicts], GOAL_PERCENT),
        _figure("reverified_bit_equal", [verdict.equal for verdict in verdicts], GOAL_PERCENT),
    ]
    if physical:
        figures.append(
            _figure("oracle_physical", [failure is None for failure in physical], PHYSICAL_GOAL_PERCENT)
        )
    reasons = Counter(failure.reason for failure in physical if failure is not None)
    told = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
    notes = (f"Against plans in physics: {told}.",) if told else ()
    return EvaluationFigures("verification", conditions, tuple(figures), notes)


def objections(verdicts: Sequence[VerificationOutcome]) -> Iterator[str]:
    """A line for each thing that speaks against a task."""
    for verdict in verdicts:
        if verdict.cached:
            yield f"{verdict.task}: {verdict.cached}"
        elif not verdict.equal:
            yield f"{verdict.task}: two processes, or one of them and the dataset, differ in plan or trace"
        if verdict.physical:
            yield f"{verdict.task}, in physics: {verdict.physical}"


def _figure(name: str, held: Sequence[bool], goal: float) -> Figure:
    return Figure(name, 100 * sum(held) / len(held), "%", Better.HIGHER, len(held), goal)
