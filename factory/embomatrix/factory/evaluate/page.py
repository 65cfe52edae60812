"""The factory's part of the page of benchmarks: tables of evaluations between two marks, all else left as it is."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Final

from embomatrix.factory.evaluate.figures import EvaluationError
from embomatrix.pages.figures import shown

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.factory.evaluate.figures import Evaluation
    from embomatrix.pages.figures import Figure

WIDTH: Final = 128
BEGIN: Final = "<!-- by hand: factory -->"
"""The page of benches keeps what stands between its marks, whoever wrote it."""
END: Final = "<!-- end by hand -->"
PARTS: Final[Mapping[str, tuple[str, str]]] = {
    "tasks": (
        "Diversity of tasks",
        "`embomatrix factory evaluate tasks`: instructions as each writer makes them for the same scene variants, not yet "
        "verified. Self-BLEU, distinct n-grams and near-duplicates are means over scenes; entropies are over all tasks, as "
        "shares of the largest possible. *plain* is the writer without social simulation. Figures grow or shrink with the "
        "number of instructions, so compare equal ones only; none is on the scale of the paper's judge.",
    ),
    "imports": (
        "Imports",
        "`embomatrix factory import … --instantiate --json FILE`: a problem counts when a base scene was built with all that "
        "it names where its start puts it, and its goal can be told true or false; whether the start holds in physics is "
        "looked at only where a task is verified. *Reached* are goals of which each literal can be made to hold by a skill "
        "of the profile.",
    ),
    "aesthetics": (
        "Aesthetics",
        "`embomatrix factory evaluate aesthetics`: a geometric score of 0 to 10, its weights fitted so that hand-made rooms "
        "score high and the same rooms with shifted, swapped or dropped furniture score low. *auc* is the chance that a "
        "hand-made room which the fit did not see scores above a spoilt one; it is not on the scale of the paper's judge.",
    ),
    "scenes": (
        "Scenes for tasks",
        "`embomatrix factory evaluate scenes`: the same tasks laid out by three methods, each scene judged by code that "
        "no method calls.",
    ),
}
"""Heading and explanation of each part, in the order of the page."""


def with_factory(page: str, evaluations: Sequence[Evaluation]) -> str:
    """The page with the factory's part replaced, or added at its end. Raises EvaluationError where a mark lacks its other."""
    text = f"{BEGIN}\n{render(evaluations)}\n{END}"
    if BEGIN not in page:
        return f"{page.rstrip()}\n\n{text}\n" if page.strip() else f"{text}\n"
    before, _, rest = page.partition(BEGIN)
    _, mark, after = rest.partition(END)
    if not mark:
        raise EvaluationError(
            f"the page has {BEGIN!r} without {END!r} after it: put it back where the part ends, so that nothing is lost"
        )
    return f"{before}{text}{after}"


def render(evaluations: Sequence[Evaluation]) -> str:
    """The part in Markdown, in the order of `PARTS`. Raises EvaluationError for an unknown part or one given twice."""
    order = [*PARTS]
    given = [evaluation.part for evaluation in evaluations]
    for part in given:
        if part not in PARTS:
            raise EvaluationError(f"there is no part {part!r}: expected {', '.join(order)}")
        if given.count(part) > 1:
            raise EvaluationError(f"part {part!r} is given twice: give one file of each part")
    lines = ["## Factory", "", "Written by `embomatrix factory evaluate page FILE...`.", ""]
    for evaluation in sorted(evaluations, key=lambda evaluation: order.index(evaluation.part)):
        heading, words = PARTS[evaluation.part]
        lines += [f"### {heading}", "", _paragraph(words), ""]
        measured = "; ".join(
            f"{name.replace('_', ' ')} {value}" for name, value in evaluation.conditions.items()
        )
        lines += [_paragraph(f"Measured: {measured}."), "", *_table(evaluation.figures), ""]
        for note in evaluation.notes:
            lines += [_paragraph(note), ""]
    return "\n".join(lines).rstrip() + "\n"


def _table(figures: Sequence[Figure]) -> list[str]:
    lines = ["| figure | value | goal | | n |", "| --- | ---: | ---: | --- | ---: |"]
    for figure in figures:
        verdict = "" if figure.goal is None else "reached" if figure.is_reached else "short"
        value = f"{shown(figure.value)} {figure.unit}".strip()
        lines.append(f"| {figure.name} | {value} | {figure.bound} | {verdict} | {figure.n:,} |")
    return lines


def _paragraph(text: str) -> str:
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)
