"""Figures of `bench fidelity`, and the replay of one disagreement step by step."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure
from embomatrix.sim.fidelity.compare import FidelityTrial, objects_in, trial_from_json, true_atoms
from embomatrix.sim.fidelity.report import MANIPULATION, FidelityReport, calls_of, report_on
from embomatrix.sim.fidelity.sampler import SKILLS
from embomatrix.skills.trace import Step
from embomatrix.world.dataset import Dataset
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.bench.fidelity.pool import Modes
    from embomatrix.bench.fidelity.suite import SuiteResult
    from embomatrix.sim.executor import Simulator

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


def read_disagreement(spot: str) -> FidelityTrial:
    """Read the trial of a line FILE:N, N from 1. Raise BenchError."""
    name, _, number = spot.rpartition(":")
    if not name or not number.isdecimal() or int(number) < 1:
        raise BenchError(f"found {spot!r}: expected FILE:N, a line of a file of disagreements, N from 1")
    with open(name, encoding="utf-8") as file:
        for count, line in enumerate(file, start=1):
            if count == int(number):
                try:
                    return trial_from_json(json.loads(line))
                except (KeyError, TypeError, ValueError) as error:
                    raise BenchError(
                        f"{spot} is no trial ({error}): expected a line that the suite wrote"
                    ) from error
    raise BenchError(f"{name} has fewer than {number} lines: name an existing line")


def replay_trial(dataset: Dataset, trial: FidelityTrial, modes: Modes) -> Iterator[str]:
    """Execute the trial again in both modes and yield lines about it. Raise DatasetError, BenchError and EngineError."""
    bundle = dataset.bundle(trial.bundle_digest)
    task = bundle.tasks.get(trial.task_id)
    if task is None:
        raise BenchError(f"the bundle has no task {trial.task_id!r}: name the dataset of the suite")
    yield f"{trial.trial_id} ({trial.kind.value} plan) in {trial.base}, task {trial.task_id}, seed {trial.seed}"
    yield f"goal: {task.goal_bddl}"
    with (
        contextlib.closing(modes.cached(bundle)) as cached,
        contextlib.closing(modes.physical(bundle)) as physical,
    ):
        cached.reset(task, trial.seed)
        physical.reset(task, trial.seed)
        for number, call in enumerate(trial.plan, start=1):
            one, other = cached.run_step(call), physical.run_step(call)
            mark = " " if one.ok is other.ok else "≠"
            yield f"{mark} {number}. {one.call.skill.value}"
            yield f"      cached:   {_line(one)}"
            yield f"      physical: {_line(other)}"
            if not (one.ok and other.ok):
                break
        yield from _atom_lines(cached, physical, task, trial)


def _line(step: Step) -> str:
    return step.message if step.failure is None else f"{step.failure.value}: {step.message}"


def _atom_lines(cached: Simulator, physical: Simulator, task: Task, trial: FidelityTrial) -> Iterator[str]:
    names = objects_in(task, trial.plan)
    one, other = true_atoms(cached, names), true_atoms(physical, names)
    yield f"atoms that hold in both: {len(one & other)}"
    yield from (f"  cached only:   {atom}" for atom in sorted(one - other))
    yield from (f"  physical only: {atom}" for atom in sorted(other - one))
