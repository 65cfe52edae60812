"""Comparison of the two execution modes: the same plan in both, step by step and atom by atom.

A *trial* is one plan in one scene with one seed. Its atoms range over the objects of the goal and of the calls, and over
their neighbours at the end: relations in both directions, rooms, states and substances. Atoms that hold in neither mode don't
count.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

import msgspec

from embomatrix.skills.failure import FailureReason
from embomatrix.skills.parse import plan_from_json, plan_to_json
from embomatrix.skills.syntax import Plan, Skill
from embomatrix.world.evaluate import objects_of
from embomatrix.world.state import Relation, State
from embomatrix.world.task import Profile, Task

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator

NEAR_M: Final = 0.5
"""Largest distance of boxes whose objects may be in a relation; ``nextto`` reaches no farther."""


class PlanKind(StrEnum):
    """Origin of a plan."""

    ORACLE = "oracle"
    VALID = "valid"
    PERTURBED = "perturbed"
    FAILING = "failing"


@dataclass(frozen=True, slots=True)
class FidelityTrial:
    """One plan to execute in both modes. ``base``: base scene of the bundle's scene."""

    trial_id: str
    bundle_digest: str
    base: str
    task_id: str
    kind: PlanKind
    seed: int
    plan: Plan


@dataclass(frozen=True, slots=True)
class StepRun:
    """One executed call; ``failure`` is None for a success. ``cpu_s``: processor time of the thread, in seconds."""

    skill: Skill
    failure: FailureReason | None
    message: str
    cpu_s: float

    @property
    def ok(self) -> bool:
        return self.failure is None


@dataclass(frozen=True, slots=True)
class ModeRun:
    """Result of a trial in one mode: steps up to the first failure, and final atoms as BDDL text.

    ``cpu_s``: processor time of the execution with its reset, in seconds.
    """

    steps: tuple[StepRun, ...]
    atoms: frozenset[str]
    cpu_s: float

    @property
    def ok(self) -> bool:
        return all(step.ok for step in self.steps)


@dataclass(frozen=True, slots=True)
class Comparison:
    """A trial in both modes. ``bodies``: number of objects in the scene."""

    trial: FidelityTrial
    bodies: int
    cached: ModeRun
    physical: ModeRun

    @property
    def pairs(self) -> tuple[tuple[StepRun, StepRun], ...]:
        """Steps that both modes reached. All outcomes before the last of these are equal."""
        return tuple(zip(self.cached.steps, self.physical.steps, strict=False))

    @property
    def steps_of_either(self) -> int:
        """Number of steps that at least one mode reached."""
        return max(len(self.cached.steps), len(self.physical.steps))

    @property
    def equal_steps(self) -> int:
        """Number of steps that both modes reached with equal success."""
        return sum(one.ok is other.ok for one, other in self.pairs)

    @property
    def first_difference(self) -> int | None:
        """Index of the first step with different outcomes, None if all are equal."""
        differing = (number for number, (one, other) in enumerate(self.pairs) if one.ok is not other.ok)
        return next(differing, None)

    @property
    def atoms_of_either(self) -> frozenset[str]:
        return self.cached.atoms | self.physical.atoms

    @property
    def equal_atoms(self) -> frozenset[str]:
        return self.cached.atoms & self.physical.atoms


def run_trial(simulator: Simulator, task: Task, trial: FidelityTrial) -> ModeRun:
    """Execute the trial's plan up to its first failure."""
    started_s = time.thread_time()
    simulator.reset(task, trial.seed)
    steps: list[StepRun] = []
    for call in trial.plan:
        before_s = time.thread_time()
        step = simulator.run_step(call)
        steps.append(StepRun(call.skill, step.failure, step.message, time.thread_time() - before_s))
        if not step.ok:
            break
    cpu_s = time.thread_time() - started_s
    return ModeRun(tuple(steps), true_atoms(simulator, objects_in(task, trial.plan)), cpu_s)


def compare(cached: Simulator, physical: Simulator, task: Task, trial: FidelityTrial) -> Comparison:
    """Execute the trial in both modes."""
    return Comparison(
        trial,
        len(cached.world.scene.objects),
        run_trial(cached, task, trial),
        run_trial(physical, task, trial),
    )


def objects_in(task: Task, plan: Plan) -> tuple[str, ...]:
    """Return the objects of the goal and of the calls, in table order. Indices outside the table are ignored."""
    rows = {row for call in plan for row in (call.object_index, call.source_index) if row is not None}
    named = objects_of(task.goal, task.types) | {
        task.table[row] for row in rows if 0 <= row < len(task.table)
    }
    return tuple(name for name in task.table if name in named)


def true_atoms(simulator: Simulator, names: Iterable[str]) -> frozenset[str]:
    """Return the true atoms over the objects and their neighbours, as BDDL text."""
    facts = simulator.facts
    return frozenset(
        f"({' '.join((predicate, *args))})"
        for predicate, args in _candidates(simulator, tuple(names))
        if facts.holds(predicate, args)
    )


def _candidates(simulator: Simulator, names: tuple[str, ...]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield atoms that may hold: objects farther apart than ``NEAR_M`` are in no relation."""
    world = simulator.world
    for name in names:
        for state in State:
            yield state.value, (name,)
        for fact in sorted(world.substances[name]):
            yield fact.relation.value, (name, fact.substance)
        for room in world.rooms:
            yield Relation.INROOM.value, (name, room)
    pairs = {
        pair
        for name in names
        if not world.engine.is_parked(name)
        for other in world.engine.near(world.engine.aabb(name).grown(NEAR_M), frozenset((name,)))
        for pair in ((name, other), (other, name))
    }
    for (one, other), relation in itertools.product(sorted(pairs), Relation):
        if relation is not Relation.INROOM:
            yield relation.value, (one, other)


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
    """Read a trial. Raises KeyError, TypeError or ValueError (PlanError among them) for invalid values."""
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
        "cached": msgspec.to_builtins(comparison.cached, order="deterministic"),
        "physical": msgspec.to_builtins(comparison.physical, order="deterministic"),
    }


def comparison_from_json(value: Mapping[str, Any]) -> Comparison:
    """Read a comparison. Raises what ``trial_from_json`` raises."""
    return Comparison(
        trial_from_json(value),
        int(value["bodies"]),
        msgspec.convert(value["cached"], ModeRun),
        msgspec.convert(value["physical"], ModeRun),
    )


def disagreement_to_json(comparison: Comparison) -> dict[str, Any]:
    """Return the trial, its first different step with both messages, and the atoms of one mode only."""
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
