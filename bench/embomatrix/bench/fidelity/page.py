"""Figures of `bench fidelity`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from embomatrix.pages.figures import Better, Figure
from embomatrix.sim.fidelity.report import MANIPULATION, FidelityReport, calls_of, report_on
from embomatrix.sim.fidelity.sampler import SKILLS

if TYPE_CHECKING:
    from embomatrix.bench.fidelity.suite import SuiteResult

ATOMS_GOAL: Final = 0.99
STEPS_GOAL: Final = 0.98
PLANS_GOAL: Final = 1_000.0
SCENES_GOAL: Final = 20.0
SUCCEEDED_GOAL: Final = 0.6
CALLS_GOAL: Final = 200.0
PLAN_S_GOAL: Final = 2.5
SPEEDUP_GOAL: Final = 100.0
MINUTES_GOAL: Final = 25.0


def figures_of(outcome: SuiteResult, minutes: float | None) -> tuple[Figure, ...]:
    """All figures. ``minutes`` is the wall time of the whole suite; None if part of it had been done before."""
    report = report_on(outcome.comparisons)
    suite = (
        () if minutes is None else (Figure("suite_minutes", minutes, "min", Better.LOWER, 1, MINUTES_GOAL),)
    )
    return (
        *_agreement(report),
        *_extent(outcome, report),
        *_physical_times(report),
        *_skill_figures(report),
        *suite,
    )


def _agreement(report: FidelityReport) -> Iterator[Figure]:
    """Shares of the compared values that are equal in both modes."""
    for name, value, compared, goal in (
        ("final_atoms_equal", report.atoms_equal, report.atoms, ATOMS_GOAL),
        ("step_outcomes_equal", report.steps_equal, report.steps, STEPS_GOAL),
        ("step_outcomes_equal_of_either", report.steps_equal_of_either, report.steps_of_either, None),
        ("step_reasons_equal", report.reasons_equal, report.steps, None),
        ("plans_equal", report.plans_equal, report.plans, None),
    ):
        yield Figure(name, value, "share", Better.HIGHER, compared, goal)


def _extent(outcome: SuiteResult, report: FidelityReport) -> Iterator[Figure]:
    """Numbers of plans, scenes and calls that were compared."""
    higher, plans, lost = Better.HIGHER, report.plans, len(outcome.lost)
    calls = calls_of(outcome.comparisons)
    rarest = float(min(calls[skill] for skill in SKILLS))
    yield Figure("plans", float(plans), "", higher, plans, PLANS_GOAL)
    yield Figure("plans_lost", float(lost), "", Better.LOWER, plans + lost, 0.0)
    yield Figure("scenes", float(report.scenes), "", higher, report.scenes, SCENES_GOAL)
    yield Figure("succeeded_in_cached_mode", report.succeeded, "share", higher, plans, SUCCEEDED_GOAL)
    yield Figure("calls_of_the_rarest_skill", rarest, "", higher, len(SKILLS), CALLS_GOAL)


def _physical_times(report: FidelityReport) -> Iterator[Figure]:
    lower, full = Better.LOWER, report.full_scene_plans
    yield Figure("physical_plan_s", report.plan_s, "s", lower, report.plans)
    if full:
        yield Figure("physical_plan_300_s", report.full_scene_plan_s, "s", lower, full, PLAN_S_GOAL)


def _skill_figures(report: FidelityReport) -> Iterator[Figure]:
    yield Figure("skill_speedup_min", report.speedup_min, "×", Better.HIGHER, len(MANIPULATION), SPEEDUP_GOAL)
    for item in report.skills:
        if item.compared:
            equal = 1.0 - item.unequal / item.compared
            yield Figure(f"equal {item.skill.value}", equal, "share", Better.HIGHER, item.compared)
        if item.speedup:
            yield Figure(f"speed-up {item.skill.value}", item.speedup, "×", Better.HIGHER, item.compared)
