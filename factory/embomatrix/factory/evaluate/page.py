"""Factory section of the benchmark page: tables of evaluations between two markers. The rest of the page is unchanged.

New figures replace the text under their heading; other headings stay.
"""

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

from embomatrix.factory.metrics.figures import EvaluationError, EvaluationFigures, verdict_on
from embomatrix.pages.figures import Figure, shown

WIDTH: Final = 128
BEGIN: Final = "<!-- by hand: factory -->"
"""Start marker. The renderer of the benchmark page keeps the text between such markers."""
END: Final = "<!-- end by hand -->"
_HEADING: Final = "\n### "
PARTS: Final[Mapping[str, tuple[str, str]]] = {
    "tasks": (
        "Diversity of tasks",
        "`embomatrix factory evaluate tasks` compares the instructions of each writer for the same scene variants, before "
        "verification. Self-BLEU, distinct n-grams and near-duplicates are means over scenes. Entropies are over all tasks, "
        "as shares of the largest possible entropy. *plain* is the writer without social simulation. These figures depend on "
        "the number of instructions, so compare only equal numbers. None is on the scale of the paper's judge.",
    ),
    "scripts": (
        "Success of scripts",
        "`embomatrix factory evaluate scripts` executes the plans of scripts on the held-out tasks of the shipped dataset, or "
        "of another `--dataset`. *template* knows all phrases of the training split, *nearest* copies the demands of the most "
        "similar training instruction, *greedy* knows the goal. A small share means that the words need more than a table of "
        "phrases.",
    ),
    "search": (
        "Searches",
        "`embomatrix factory evaluate search` plays an episode of each held-out task that shows only what the robot has seen. "
        "A script knows what to do and with which objects, and looks for those that it has not seen, by how often training "
        "tasks have them in a room or a piece of furniture. It has twice the calls of an oracle that sees everything, and 12 "
        "more.",
    ),
    "readings": (
        "Readers",
        "`embomatrix factory evaluate readings` judges answers of readers who saw prompts of held-out tasks only: the packaged "
        "ones to the shipped dataset, or `--answers FILE` to another `--dataset`. *human_success* is the share of their plans "
        "that succeed, *instruction_goal_agreement* the share of goals that equal the task's or are equivalent by execution. "
        "The packaged answers are by seven instances of a large language model, none by people.",
    ),
    "admission": (
        "Admission",
        "`embomatrix factory evaluate admission --dataset DATASET` reads the ledger of a build. *admitted_per_hour* is "
        "computed from CPU time for two dedicated cores. The time covers writing, layout, reachability analysis and "
        "verification of all drafts, and the base scenes. *plain* is the writer without social simulation.",
    ),
    "skills": (
        "Needed skills",
        "`embomatrix factory evaluate skills --dataset DATASET` executes the oracle's plan of each task again without the "
        "calls of one skill. A task needs the skill if its goal is then missed. *skill_share_min* is the smallest share of "
        "tasks that need a skill, among the skills that a goal can need; docs/skills.md lists the others. Rows with *place* "
        "are about one relation.",
    ),
    "imports": (
        "Imports",
        "`embomatrix factory import … --instantiate --json FILE`: a problem counts as imported if a base scene was built with "
        "every object in its initial place, and its goal can be evaluated. Only verification checks the initial state in "
        "physics. *Reached* are goals for which a skill of the profile can achieve each literal. *Solved* are the reached "
        "goals that the oracle solves in a scene, measured without `--instantiate`.",
    ),
    "verification": (
        "Tasks verified again",
        "`embomatrix factory verify --physical` verifies admitted tasks again in two new processes. *oracle_cached* is "
        "the share that is admitted again. *reverified_bit_equal* is the share with the dataset's plan and with bit-identical "
        "poses and states after every step. *oracle_physical* is the share whose plan a robot executes in stepped physics.",
    ),
    "faithfulness": (
        "Faithful goals",
        "`embomatrix factory audit --plans N` compares what each instruction demands with what its goal scores, and "
        "searches for shortcuts: plans that succeed while they violate a relation, source or object that the instruction "
        "states. *shortcut_share* is the share of tasks with one, *relation_swaps* the number of placement tasks solved with "
        "another relation, *unfaithful_share* the share of tasks whose words and goal disagree.",
    ),
    "lies": (
        "Lying models",
        "`embomatrix factory evaluate lies` runs the model writer on a scripted model that tells one lie of a table, again "
        "and again. *lies_refused* is the share of lies of which no task comes, *lies_refused_by_rules* the share that the "
        "rules refuse without the validation agent. *honest_admitted* is the share of honest requests that are admitted. Calls "
        "and tokens are those of the honest requests, two in each dialogue, in the first dialogue of a home, without "
        "corrections; tokens are words and punctuation marks.",
    ),
    "aesthetics": (
        "Aesthetics",
        "`embomatrix factory evaluate aesthetics` computes a geometric score of 0 to 10 for the objects that are added to a "
        "room. It is fitted to give hand-made rooms high scores, and the same rooms with shifted, swapped, dropped or "
        "scattered objects low scores. *auc* is the probability that a hand-made room outside the fit scores above a spoilt "
        "one, with all objects of the rooms as added ones. In *half added* a random half of them is added, spoilt and "
        "scored. The score is not on the scale of the paper's judge.",
    ),
    "looks": (
        "Scenes, as a model sees them",
        "`embomatrix factory evaluate looks`: score of 0 to 10 that a language model gives labelled floor plans, with the "
        "paper's prompt. The scale is the model's own.",
    ),
    "scenes": (
        "Scenes for tasks",
        "`embomatrix factory evaluate scenes` lays out the same tasks with three methods and checks each scene with code that "
        "no method uses. *poses* are those that a language model, the pose model below, wrote for the task; *poses_written* "
        "is the share of tasks for which it wrote a usable pose for every object. *aesthetics* is the score of the added "
        "objects in the tasks that a method laid out, *aesthetics_shared* in the tasks that all methods laid out.",
    ),
    "rooms": (
        "Rooms of base scenes",
        "`embomatrix factory evaluate rooms` builds the base scenes and counts with code that the furnishing does not use. "
        "*objects_per_living_room* and its like are medians over the rooms of homes, background included; the goals are 15 % "
        "below the medians of 195 hand-made rooms of iTHOR. *carpet_under_share* is the share of rugs that lie under "
        "furniture, in rooms with furniture for them; *floating_slabs* counts worktops that nothing carries, *low_lamps* "
        "lamps and fans below 2 m with nothing under them.",
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
    lines = ["## Factory", "", "Written by `embomatrix factory evaluate PART... --page FILE`."]
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
            raise EvaluationError(f"unknown part {evaluation.part!r}: expected one of {', '.join(PARTS)}")
    found = {part: [each for each in evaluations if each.part == part] for part in PARTS}
    for part, mine in found.items():
        counts = Counter(figure.name for each in mine for figure in each.figures)
        twice = next((name for name, count in counts.items() if count > 1), "")
        if twice:
            raise EvaluationError(
                f"figure {twice!r} of part {part!r} is in two files: pass one file per measurement"
            )
    return {part: mine for part, mine in found.items() if mine}


def _table(figures: Sequence[Figure]) -> list[str]:
    lines = ["| figure | value | goal | | n |", "| --- | ---: | ---: | --- | ---: |"]
    for figure in figures:
        value = f"{shown(figure.value)} {figure.unit}".strip()
        lines.append(f"| {figure.name} | {value} | {figure.bound} | {verdict_on(figure)} | {figure.n:,} |")
    return lines


def _paragraph(text: str) -> str:
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)
