"""Report on imported problems: outcomes, refusals with reasons, unreachable goals, and import rates."""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.metrics.figures import EvaluationFigures
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.factory.task_import.batch import Imported, Verified
from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.reach import unreachable_atoms
from embomatrix.factory.task_import.sources import BEHAVIOR, EAI, SourceText
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.task import Profile

FIGURES: Final[Mapping[str, tuple[str, float]]] = {
    "embomatrix": ("import_rate_sample", 0.97),
    BEHAVIOR: ("import_rate_behavior", 0.6),
    EAI: ("import_rate_eai", 1.0),
}
"""Name and target of the figure for each source."""
SOLVED_GOAL: Final = 0.95


@dataclass(frozen=True, slots=True)
class ProblemOutcome:
    """Outcome of one problem.

    ``scene`` is its base scene; if the problem is refused, ``reason`` and ``sentence`` are set instead.

    ``unreachable`` lists the goal's literals that no skill achieves, by profile. ``notes`` lists changes made to the
    problem.
    """

    name: str
    source: str
    scene: str
    reason: str
    sentence: str
    unreachable: Mapping[str, tuple[str, ...]]
    notes: tuple[str, ...]

    @property
    def is_bound(self) -> bool:
        return not self.reason


def outcome_from_json(value: dict[str, Any]) -> ProblemOutcome:
    """Decode an outcome from JSON. Raise KeyError or TypeError."""
    unreachable = {profile: tuple(atoms) for profile, atoms in value["unreachable"].items()}
    return ProblemOutcome(**{**value, "unreachable": unreachable, "notes": tuple(value["notes"])})


def outcome_of(source: SourceText, imported: Imported) -> ProblemOutcome:
    """Return the outcome of a problem for the report. Raise BddlError."""
    problem, notes = read_problem(source)
    unreachable = {profile.value: unreachable_atoms(problem, profile) for profile in Profile}
    if isinstance(imported, TaskRefusal):
        scene, reason, sentence = "", imported.reason.value, imported.sentence
    else:
        task = imported.record.task if isinstance(imported, Verified) else imported.task
        scene, reason, sentence, notes = base_scene_of(task.scene_id), "", "", imported.notes
    return ProblemOutcome(source.name, source.source, scene, reason, sentence, unreachable, notes)


def report_to_json(outcomes: Sequence[ProblemOutcome]) -> dict[str, Any]:
    """Return the report as a JSON-serialisable dict: counts, then every problem."""
    return {
        "problems": len(outcomes),
        "bound": sum(outcome.is_bound for outcome in outcomes),
        "refused": dict(Counter(outcome.reason for outcome in outcomes if outcome.reason).most_common()),
        "outcomes": [dataclasses.asdict(outcome) for outcome in outcomes],
    }


def report_to_markdown(outcomes: Sequence[ProblemOutcome]) -> str:
    """Return the report as Markdown."""
    bound = sum(outcome.is_bound for outcome in outcomes)
    lines = ["# Imported problems", "", f"{bound} of {len(outcomes)} are bound to a scene.", ""]
    refused = Counter(outcome.reason for outcome in outcomes if outcome.reason)
    if refused:
        lines += ["| refused | problems |", "| --- | ---: |"]
        lines += [f"| {reason} | {count} |" for reason, count in refused.most_common()]
        lines += ["", "## Refused", ""]
        lines += [f"* `{each.name}` ({each.reason}): {each.sentence}" for each in outcomes if each.reason]
        lines += [""]
    for profile in Profile:
        short = [outcome for outcome in outcomes if outcome.unreachable[profile.value]]
        lines += [
            f"## Goals that the profile `{profile.value}` does not reach: {len(short)}",
            "",
            *(
                f"* `{each.name}`: {', '.join(f'`{atom}`' for atom in each.unreachable[profile.value])}"
                for each in short
            ),
            "",
        ]
    read = [outcome for outcome in outcomes if outcome.notes]
    lines += [f"## Read into problems: {len(read)}", ""]
    lines += [f"* `{each.name}`: {'; '.join(each.notes)}" for each in read]
    return "\n".join(lines).rstrip() + "\n"


def evaluation_of(outcomes: Sequence[ProblemOutcome], seed: int) -> EvaluationFigures:
    """Return import rates by source, and the share of goals that each profile reaches."""
    figures: list[Figure] = []
    for source, (name, goal) in FIGURES.items():
        selected = [outcome for outcome in outcomes if outcome.source == source]
        if not selected:
            continue
        n = len(selected)
        figures.append(Figure(name, sum(each.is_bound for each in selected) / n, "", Better.HIGHER, n, goal))
        for profile in Profile:
            reached = sum(not each.unreachable[profile.value] for each in selected)
            figures.append(Figure(f"{name} reached by {profile.value}", reached / n, "", Better.NEITHER, n))
    return EvaluationFigures("imports", {"seed": seed}, tuple(figures))


def solved_of(outcomes: Sequence[ProblemOutcome], seed: int, *, solids: bool = False) -> EvaluationFigures:
    """Return the share of reachable goals that the oracle solved, by source and profile.

    ``solids`` is true if problems with substances were left out.
    """
    without = " without liquids" if solids else ""
    figures: list[Figure] = []
    for source, (name, _) in FIGURES.items():
        for profile in Profile:
            selected = [
                each for each in outcomes if each.source == source and not each.unreachable[profile.value]
            ]
            if selected:
                title = (
                    f"{name.replace('import_rate', 'oracle_solved')} of what {profile.value} reaches{without}"
                )
                goal = SOLVED_GOAL if profile is Profile.PAPER else None
                share = sum(each.is_bound for each in selected) / len(selected)
                figures.append(Figure(title, share, "", Better.HIGHER, len(selected), goal))
    return EvaluationFigures("imports", {"seed": seed}, tuple(figures))
