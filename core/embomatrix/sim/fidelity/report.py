"""Figures of the fidelity suite, computed from its comparisons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.skills.syntax import Skill

if TYPE_CHECKING:
    from embomatrix.sim.fidelity.compare import Comparison

MANIPULATION: Final = (
    Skill.PICK_UP,
    Skill.PLACE,
    Skill.OPEN,
    Skill.CLOSE,
    Skill.TOGGLE_ON,
    Skill.TOGGLE_OFF,
)
"""Skills that use the arm, whose speed-up has a bound."""
FULL_SCENE: Final = (250, 350)
"""Range of object counts of a scene that counts as one of about 300 bodies."""


@dataclass(frozen=True, slots=True)
class SkillReport:
    """Figures of one skill over all trials. ``calls`` and ``succeeded`` refer to cached mode.

    Both modes reached ``compared`` calls; ``unequal`` of them had different outcomes. Times are mean
    processor seconds of calls that succeeded in both modes.
    """

    skill: Skill
    calls: int
    succeeded: int
    compared: int
    unequal: int
    cached_s: float
    physical_s: float

    @property
    def speedup(self) -> float:
        """Ratio of physical to cached time; 0 without measurements."""
        return self.physical_s / self.cached_s if self.cached_s > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class FidelityReport:
    """Figures of the suite. Shares refer to the totals beside them; a share of nothing is 1.

    ``steps_equal`` counts steps that both modes reached, ``steps_equal_of_either`` all steps that one mode reached: after a
    difference one mode stops, so its later steps have no counterpart.
    """

    plans: int
    scenes: int
    succeeded: float
    atoms: int
    atoms_equal: float
    plans_equal: float
    steps: int
    steps_equal: float
    steps_of_either: int
    steps_equal_of_either: float
    reasons_equal: float
    plan_s: float
    full_scene_plans: int
    full_scene_plan_s: float
    skills: tuple[SkillReport, ...]

    @property
    def speedup_min(self) -> float:
        """Least measured speed-up of a manipulation skill."""
        found = [item.speedup for item in self.skills if item.skill in MANIPULATION and item.speedup > 0.0]
        return min(found, default=0.0)


def report_on(comparisons: Sequence[Comparison]) -> FidelityReport:
    """Compute the figures. An empty suite has zero plans and shares of 1."""
    pairs = [pair for item in comparisons for pair in item.pairs]
    equal_steps = sum(item.equal_steps for item in comparisons)
    steps_of_either = sum(item.steps_of_either for item in comparisons)
    atoms = sum(len(item.atoms_of_either) for item in comparisons)
    full = [item for item in comparisons if FULL_SCENE[0] <= item.bodies <= FULL_SCENE[1]]
    return FidelityReport(
        plans=len(comparisons),
        scenes=len({item.trial.base for item in comparisons}),
        succeeded=_ratio(sum(item.cached.ok for item in comparisons), len(comparisons)),
        atoms=atoms,
        atoms_equal=_ratio(sum(len(item.equal_atoms) for item in comparisons), atoms),
        plans_equal=_ratio(sum(item.first_difference is None for item in comparisons), len(comparisons)),
        steps=len(pairs),
        steps_equal=_ratio(equal_steps, len(pairs)),
        steps_of_either=steps_of_either,
        steps_equal_of_either=_ratio(equal_steps, steps_of_either),
        reasons_equal=_ratio(sum(one.failure is other.failure for one, other in pairs), len(pairs)),
        plan_s=_mean([item.physical.cpu_s for item in comparisons]),
        full_scene_plans=len(full),
        full_scene_plan_s=_mean([item.physical.cpu_s for item in full]),
        skills=tuple(_skill_report(skill, comparisons) for skill in Skill),
    )


def calls_of(comparisons: Iterable[Comparison]) -> Counter[Skill]:
    """Count the calls of each skill that cached mode reached."""
    return Counter(step.skill for item in comparisons for step in item.cached.steps)


def _skill_report(skill: Skill, comparisons: Sequence[Comparison]) -> SkillReport:
    mine = [step for item in comparisons for step in item.cached.steps if step.skill is skill]
    pairs = [pair for item in comparisons for pair in item.pairs if pair[0].skill is skill]
    both = [(one, other) for one, other in pairs if one.ok and other.ok]
    return SkillReport(
        skill,
        calls=len(mine),
        succeeded=sum(step.ok for step in mine),
        compared=len(pairs),
        unequal=sum(one.ok is not other.ok for one, other in pairs),
        cached_s=_mean([one.cpu_s for one, _ in both]),
        physical_s=_mean([other.cpu_s for _, other in both]),
    )


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else 1.0


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else 0.0
