"""Trials and comparisons as plain JSON values: a line of a file each, so that a suite that was cut short goes on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from embomatrix.sim.fidelity.compare import Comparison, FidelityTrial, ModeRun, PlanKind, StepRun
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.parse import plan_from_json, plan_to_json
from embomatrix.skills.syntax import Skill
from embomatrix.world.task import Profile

if TYPE_CHECKING:
    from collections.abc import Mapping


def trial_to_json(trial: FidelityTrial) -> dict[str, Any]:
    return {
        "trial": trial.trial_id,
        "bundle": trial.bundle_digest,
        "base": trial.base,
        "task": trial.task_id,
        "kind": trial.kind.value,
        "seed": trial.seed,
        "plan": plan_to_json(trial.plan),
    }


def trial_from_json(value: Mapping[str, Any]) -> FidelityTrial:
    """Raises KeyError, TypeError or ValueError (PlanError among them) for what is no trial."""
    return FidelityTrial(
        value["trial"],
        value["bundle"],
        value["base"],
        value["task"],
        PlanKind(value["kind"]),
        int(value["seed"]),
        plan_from_json(value["plan"], Profile.HOUSEHOLD),
    )


def comparison_to_json(comparison: Comparison) -> dict[str, Any]:
    return {
        **trial_to_json(comparison.trial),
        "bodies": comparison.bodies,
        "cached": _run_to_json(comparison.cached),
        "physical": _run_to_json(comparison.physical),
    }


def comparison_from_json(value: Mapping[str, Any]) -> Comparison:
    """Raises what ``trial_from_json`` raises."""
    return Comparison(
        trial_from_json(value),
        int(value["bodies"]),
        _run_from_json(value["cached"]),
        _run_from_json(value["physical"]),
    )


def disagreement_to_json(comparison: Comparison) -> dict[str, Any]:
    """What is needed to look at a disagreement: the trial, the first step that differs with both sentences, the atoms."""
    found = trial_to_json(comparison.trial)
    index = comparison.first_difference
    if index is not None:
        one, other = comparison.pairs[index]
        found |= {
            "step": index + 1,
            "skill": one.skill.value,
            "cached": one.message,
            "physical": other.message,
        }
    return found | {
        "only_cached": sorted(comparison.cached.atoms - comparison.physical.atoms),
        "only_physical": sorted(comparison.physical.atoms - comparison.cached.atoms),
    }


def _run_to_json(run: ModeRun) -> dict[str, Any]:
    return {
        "steps": [
            [step.skill.value, step.failure.value if step.failure else "", step.message, round(step.cpu_s, 6)]
            for step in run.steps
        ],
        "atoms": sorted(run.atoms),
        "cpu_s": round(run.cpu_s, 6),
    }


def _run_from_json(value: Mapping[str, Any]) -> ModeRun:
    steps = tuple(
        StepRun(Skill(skill), FailureReason(failure) if failure else None, message, float(cpu_s))
        for skill, failure, message, cpu_s in value["steps"]
    )
    return ModeRun(steps, frozenset(value["atoms"]), float(value["cpu_s"]))
