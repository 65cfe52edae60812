"""Report on imported problems: outcomes, refusals with reasons, unreachable goals, and import rates."""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.metrics.figures import EvaluationFigures
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.factory.task_import.batch import Imported, Verified
from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.reach import unreachable_atoms
from embomatrix.factory.task_import.scene_changes import SceneChange, find_right_scene
from embomatrix.factory.task_import.sources import BEHAVIOR, EAI, SourceText
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.scene import Scene
from embomatrix.world.task import Profile

FIGURES: Final[Mapping[str, tuple[str, float]]] = {
    "embomatrix": ("import_rate_sample", 0.98),
    BEHAVIOR: ("import_rate_behavior", 0.6),
    EAI: ("import_rate_eai", 1.0),
}
"""Name and target of the figure for each source."""
SOLVED_GOAL: Final = 0.95
MOST_NAMED: Final = 4
"""Number of base scenes up to which the conditions name them; more are counted."""
REPORT_MARK: Final = b"# Imported problems"
"""First line of each report in Markdown."""
FAITHFUL_GOAL: Final = 0.6


@dataclass(frozen=True, slots=True)
class ProblemOutcome:
    """Outcome of one problem.

    ``scene`` is its base scene; if the problem is refused, ``reason`` and ``sentence`` are set instead.

    ``unreachable`` lists the goal's literals that no skill achieves, by profile. ``notes`` lists changes made to the
    problem. ``changes`` makes the binding unfaithful, one entry for each piece, object or room. ``has_right_scene`` says that
    one of the scenes has all rooms and furniture of the problem.
    """

    name: str
    source: str
    scene: str
    reason: str
    sentence: str
    unreachable: Mapping[str, tuple[str, ...]]
    notes: tuple[str, ...]
    changes: tuple[SceneChange, ...] = ()
    has_right_scene: bool = False

    @property
    def is_bound(self) -> bool:
        return not self.reason

    @property
    def is_faithful(self) -> bool:
        """True if the problem is bound, and nothing but its own objects was added."""
        return self.is_bound and not self.changes

    def is_reached_by(self, profile: Profile) -> bool:
        """True if a skill of the profile achieves each literal of the goal."""
        return self.reason != RefusalReason.UNPARSABLE and not self.unreachable[profile.value]


def outcome_from_json(value: dict[str, Any]) -> ProblemOutcome:
    """Decode an outcome from JSON. Raise KeyError or TypeError."""
    unreachable = {profile: tuple(atoms) for profile, atoms in value["unreachable"].items()}
    changes = tuple(map(SceneChange, value["changes"]))
    return ProblemOutcome(
        **{**value, "unreachable": unreachable, "notes": tuple(value["notes"]), "changes": changes}
    )


def outcome_of(
    source: SourceText,
    imported: Imported,
    scenes: Sequence[str],
    own: Mapping[str, Scene] = MappingProxyType({}),
) -> ProblemOutcome:
    """Return the outcome of a problem that was imported into one of the scenes; ``own`` are those of files. Raise BddlError."""
    problem, notes = read_problem(source)
    unreachable = {profile.value: unreachable_atoms(problem, profile) for profile in Profile}
    has_right_scene = find_right_scene(source, problem, scenes, own) is not None
    if isinstance(imported, TaskRefusal):
        return ProblemOutcome(
            source.name,
            source.source,
            "",
            imported.reason.value,
            imported.sentence,
            unreachable,
            notes,
            has_right_scene=has_right_scene,
        )
    task = imported.record.task if isinstance(imported, Verified) else imported.task
    scene, changes = base_scene_of(task.scene_id), imported.changes
    return ProblemOutcome(
        source.name, source.source, scene, "", "", unreachable, imported.notes, changes, has_right_scene
    )


def unparsable_outcome(source: SourceText, sentence: str) -> ProblemOutcome:
    """Return the outcome of a text that is no BDDL."""
    return ProblemOutcome(source.name, source.source, "", RefusalReason.UNPARSABLE, sentence, {}, ())


def report_to_json(outcomes: Sequence[ProblemOutcome]) -> dict[str, Any]:
    """Return the report as a JSON-serialisable dict: counts, then every problem."""
    return {
        "problems": len(outcomes),
        "bound": sum(outcome.is_bound for outcome in outcomes),
        "refused": dict(Counter(outcome.reason for outcome in outcomes if outcome.reason).most_common()),
        "faithful": sum(outcome.is_faithful for outcome in outcomes),
        "right_scene": sum(outcome.has_right_scene for outcome in outcomes),
        "faithful_with_right_scene": sum(each.is_faithful and each.has_right_scene for each in outcomes),
        "changed": dict(changed_problems(outcomes)),
        "outcomes": [dataclasses.asdict(outcome) for outcome in outcomes],
    }


def changed_problems(outcomes: Sequence[ProblemOutcome]) -> list[tuple[SceneChange, int]]:
    """Return the number of bound problems with each kind of change, the commonest first."""
    return Counter(change for each in outcomes for change in set(each.changes)).most_common()


def report_to_markdown(outcomes: Sequence[ProblemOutcome]) -> str:
    """Return the report as Markdown."""
    bound = sum(outcome.is_bound for outcome in outcomes)
    lines = [REPORT_MARK.decode(), "", f"{bound} of {len(outcomes)} are bound to a scene.", ""]
    refused = Counter(outcome.reason for outcome in outcomes if outcome.reason)
    if refused:
        lines += ["| refused | problems |", "| --- | ---: |"]
        lines += [f"| {reason} | {count} |" for reason, count in refused.most_common()]
        lines += ["", "## Refused", ""]
        lines += [f"* `{each.name}` ({each.reason}): {each.sentence}" for each in outcomes if each.reason]
        lines += [""]
    lines += _faithfulness(outcomes)
    for profile in Profile:
        short = [each for each in outcomes if each.unreachable.get(profile.value)]
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


def _faithfulness(outcomes: Sequence[ProblemOutcome]) -> list[str]:
    """Return a section about faithful bindings and about changes."""
    right = [each for each in outcomes if each.has_right_scene]
    faithful = sum(each.is_faithful for each in outcomes)
    lines = [
        f"## Faithful bindings: {faithful}",
        "",
        f"{len(right)} problems have a scene with all their rooms and furniture; "
        f"{sum(each.is_faithful for each in right)} of these are bound without any change.",
        "",
    ]
    changed = changed_problems(outcomes)
    if changed:
        lines += ["| change | problems |", "| --- | ---: |"]
        lines += [f"| {change} | {count} |" for change, count in changed]
        lines += [""]
    return lines


@dataclass(frozen=True, slots=True)
class ImportScope:
    """Scope of an import: its depth, base scenes and filters. Rates of different scopes are not comparable.

    ``reached_by`` and ``solids`` say which problems were left out beforehand.
    """

    depth: str = ""
    scenes: tuple[str, ...] = ()
    reached_by: Profile | None = None
    solids: bool = False

    @property
    def is_filtered(self) -> bool:
        """True if problems are left out, or refused because no skill reaches their goals."""
        return self.reached_by is not None or self.solids or self.depth == "bind"

    @property
    def conditions(self) -> dict[str, str | int]:
        """Scope as conditions of measurement."""
        filters = (
            *((f"reached by {self.reached_by}",) if self.reached_by is not None else ()),
            *(("without liquids",) if self.solids else ()),
        )
        named = ", ".join(self.scenes)
        return {
            **({"depth": self.depth} if self.depth else {}),
            **(
                {"base scenes": named if len(self.scenes) <= MOST_NAMED else len(self.scenes)}
                if self.scenes
                else {}
            ),
            **({"problems": " and ".join(filters)} if filters else {}),
        }


EVERYTHING: Final = ImportScope()


def evaluation_of(
    outcomes: Sequence[ProblemOutcome], seed: int, scope: ImportScope = EVERYTHING
) -> EvaluationFigures:
    """Return import rates by source, and the share of goals that each profile reaches.

    Only rates of all problems have goals: a filter leaves out those that are hard to bind.
    """
    figures: list[Figure] = []
    for source, (name, goal) in FIGURES.items():
        selected = [outcome for outcome in outcomes if outcome.source == source]
        if not selected:
            continue
        n = len(selected)
        bound = sum(each.is_bound for each in selected) / n
        figures.append(Figure(name, bound, "", Better.HIGHER, n, None if scope.is_filtered else goal))
        for profile in Profile:
            reached = sum(each.is_reached_by(profile) for each in selected)
            figures.append(Figure(f"{name} reached by {profile.value}", reached / n, "", Better.NEITHER, n))
        figures += _faithful_shares(selected, name, None if scope.is_filtered else FAITHFUL_GOAL)
    return EvaluationFigures("imports", {"seed": seed, **scope.conditions}, tuple(figures))


def _faithful_shares(
    outcomes: Sequence[ProblemOutcome], name: str, faithful_goal: float | None
) -> list[Figure]:
    """Return the share of problems bound without changes: of those with a right scene, and of all."""
    right = [each for each in outcomes if each.has_right_scene]
    title = name.replace("import_rate", "faithful_share")
    figures = []
    for selected, words, goal in ((right, "", faithful_goal), (outcomes, " of all", None)):
        if selected:
            share = sum(each.is_faithful for each in selected) / len(selected)
            figures.append(Figure(f"{title}{words}", share, "", Better.HIGHER, len(selected), goal))
    return figures


def solved_of(
    outcomes: Sequence[ProblemOutcome], seed: int, scope: ImportScope = EVERYTHING
) -> EvaluationFigures:
    """Return the share of reachable goals that the oracle solved, by source and profile.

    The names of these figures say over which problems they are, so they keep their goals under a filter. After a filter by a
    profile, only that profile has figures: the others would lack problems.
    """
    without = " without liquids" if scope.solids else ""
    figures: list[Figure] = []
    for source, (name, _) in FIGURES.items():
        for profile in Profile if scope.reached_by is None else (scope.reached_by,):
            selected = [each for each in outcomes if each.source == source and each.is_reached_by(profile)]
            if selected:
                title = (
                    f"{name.replace('import_rate', 'oracle_solved')} of what {profile.value} reaches{without}"
                )
                goal = SOLVED_GOAL if profile is Profile.PAPER else None
                share = sum(each.is_bound for each in selected) / len(selected)
                figures.append(Figure(title, share, "", Better.HIGHER, len(selected), goal))
    return EvaluationFigures("imports", {"seed": seed, **scope.conditions}, tuple(figures))
