"""Factory section of the benchmark page: tables of evaluations between two markers. The rest of the page stays as it is.

New figures replace the text under their heading; other headings stay.
"""

from __future__ import annotations

import textwrap
from collections import Counter
from typing import TYPE_CHECKING, Final

from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.pages.figures import shown

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.factory.metrics.figures import EvaluationFigures
    from embomatrix.pages.figures import Figure

WIDTH: Final = 128
BEGIN: Final = "<!-- by hand: factory -->"
"""Start marker. The renderer of the benchmark page keeps the text between such markers."""
END: Final = "<!-- end by hand -->"
_HEADING: Final = "\n### "
PARTS: Final[Mapping[str, tuple[str, str]]] = {
    "tasks": (
        "Diversity of tasks",
        "`embomatrix factory evaluate tasks`: instructions as each writer makes them for the same scene variants, not yet "
        "verified. Self-BLEU, distinct n-grams and near-duplicates are means over scenes; entropies are over all tasks, as "
        "shares of the largest possible. *plain* is the writer without social simulation. Figures grow or shrink with the "
        "number of instructions, so compare equal ones only; none is on the scale of the paper's judge.",
    ),
    "admission": (
        "Admission",
        "`embomatrix factory evaluate admissions DATASET`: by the ledger of a build. *admitted_per_hour* is by processor time, "
        "on two cores that do nothing else: writing, layout, look-ahead and judging of all drafts, and the base scenes. "
        "*plain* is the writer without social simulation.",
    ),
    "imports": (
        "Imports",
        "`embomatrix factory import … --instantiate --json FILE`: a problem counts when a base scene was built with all that "
        "it names where its start puts it, and its goal can be told true or false; whether the start holds in physics is "
        "looked at only where a task is verified. *Reached* are goals of which each literal can be made to hold by a skill "
        "of the profile; *solved*, measured without `--instantiate`, are those of them that the oracle solves in a scene.",
    ),
    "verification": (
        "Tasks verified again",
        "`embomatrix factory verify DATASET --physical`: admitted tasks, judged anew in two other processes. *oracle_cached* "
        "are those admitted again, *reverified_bit_equal* those whose plans are the dataset's and whose poses and states are "
        "the same to the bit after every step; in *oracle_physical* a robot carries the dataset's plan out in stepped physics.",
    ),
    "aesthetics": (
        "Aesthetics",
        "`embomatrix factory evaluate aesthetics`: a geometric score of 0 to 10, its weights fitted so that hand-made rooms "
        "score high and the same rooms with shifted, swapped or dropped furniture score low. *auc* is the chance that a "
        "hand-made room which the fit did not see scores above a spoilt one; it is not on the scale of the paper's judge.",
    ),
    "looks": (
        "Scenes, as a model sees them",
        "`embomatrix factory evaluate looks`: points of 10 that a language model gives for labelled plans, with the paper's "
        "prompt. Its scale is the model's own.",
    ),
    "scenes": (
        "Scenes for tasks",
        "`embomatrix factory evaluate scenes`: the same tasks laid out by three methods, each scene judged by code that "
        "no method calls. *aesthetics* is of what a method laid out, *aesthetics_shared* of the tasks that all of them did: "
        "simple ones fail at crowded rooms, which score low. The score is of whole rooms, most of which no method touches.",
    ),
}
"""Heading and explanation of each part, in the order of the page."""


def with_factory(page: str, evaluations: Sequence[EvaluationFigures]) -> str:
    """Return the page with these evaluations in the factory's section, which is appended if missing.

    Raises EvaluationError for a missing end marker, an unknown part, or a figure that two files contain.
    """
    there = _there(page.partition(BEGIN)[2].partition(END)[0])
    text = f"{BEGIN}\n{_render({**there, **_measured(evaluations)})}\n{END}"
    if BEGIN not in page:
        return f"{page.rstrip()}\n\n{text}\n" if page.strip() else f"{text}\n"
    before, _, rest = page.partition(BEGIN)
    _, mark, after = rest.partition(END)
    if not mark:
        raise EvaluationError(
            f"the page has {BEGIN!r} without {END!r} after it: insert it at the end of the factory's section"
        )
    return f"{before}{text}{after}"


def _there(text: str) -> dict[str, str]:
    """Return the text under the heading of each part."""
    headings = {heading: part for part, (heading, _) in PARTS.items()}
    found = {}
    for section in text.split(_HEADING)[1:]:
        heading, _, rest = section.partition("\n")
        if heading in headings:
            found[headings[heading]] = rest.strip()
    return found


def _render(sections: Mapping[str, str]) -> str:
    """Return the section as Markdown, in the order of `PARTS`."""
    lines = ["## Factory", "", "Written by `embomatrix factory evaluate page FILE...`."]
    for part, (heading, _) in PARTS.items():
        if part in sections:
            lines += [f"{_HEADING}{heading}", "", sections[part]]
    return "\n".join(lines) + "\n"


def _measured(evaluations: Sequence[EvaluationFigures]) -> dict[str, str]:
    """Return the text of each part; files of one part are combined."""
    sections = {}
    for part, mine in _by_part(evaluations).items():
        lines = [_paragraph(PARTS[part][1]), ""]
        measured = dict.fromkeys(
            "; ".join(f"{name.replace('_', ' ')} {value}" for name, value in each.conditions.items())
            for each in mine
        )
        lines += [_paragraph(f"Measured: {text}.") for text in measured]
        lines += ["", *_table([figure for each in mine for figure in each.figures]), ""]
        for note in (note for each in mine for note in each.notes):
            lines += [_paragraph(note), ""]
        sections[part] = "\n".join(lines).strip()
    return sections


def _by_part(evaluations: Sequence[EvaluationFigures]) -> dict[str, list[EvaluationFigures]]:
    """Group evaluations by part, in the order of the page. Raises EvaluationError."""
    for evaluation in evaluations:
        if evaluation.part not in PARTS:
            raise EvaluationError(f"there is no part {evaluation.part!r}: expected {', '.join(PARTS)}")
    found = {part: [each for each in evaluations if each.part == part] for part in PARTS}
    for part, mine in found.items():
        counts = Counter(figure.name for each in mine for figure in each.figures)
        twice = next((name for name, count in counts.items() if count > 1), "")
        if twice:
            raise EvaluationError(
                f"{twice!r} of part {part!r} is given twice: give one file of each measurement"
            )
    return {part: mine for part, mine in found.items() if mine}


def _table(figures: Sequence[Figure]) -> list[str]:
    lines = ["| figure | value | goal | | n |", "| --- | ---: | ---: | --- | ---: |"]
    for figure in figures:
        verdict = "" if figure.goal is None else "reached" if figure.is_reached else "short"
        value = f"{shown(figure.value)} {figure.unit}".strip()
        lines.append(f"| {figure.name} | {value} | {figure.bound} | {verdict} | {figure.n:,} |")
    return lines


def _paragraph(text: str) -> str:
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)
