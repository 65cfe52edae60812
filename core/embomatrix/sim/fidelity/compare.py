"""How far two execution modes agree: the same plan in both, compared step by step and atom by atom.

A *trial* is one plan in one scene with one seed. Its atoms are those over the objects of the goal and of the plan's calls, and
whatever is near these at the end: relations both ways, rooms, states and substances. No atom that holds nowhere is counted.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.world.evaluate import objects_of
from embomatrix.world.geometry import Aabb
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from embomatrix.sim.executor import Simulator
    from embomatrix.skills.failure import FailureReason
    from embomatrix.skills.syntax import Plan, Skill
    from embomatrix.world.task import Task

NEAR_M: Final = 0.5
"""Objects whose boxes come this near may stand in a relation: ``nextto`` reaches no farther."""


class PlanKind(StrEnum):
    """Where a plan comes from."""

    ORACLE = "oracle"
    VALID = "valid"
    PERTURBED = "perturbed"
    FAILING = "failing"


@dataclass(frozen=True, slots=True)
class FidelityTrial:
    """One plan to be executed in both modes. ``base`` is the base scene that the bundle's scene was made from."""

    trial_id: str
    bundle_digest: str
    base: str
    task_id: str
    kind: PlanKind
    seed: int
    plan: Plan


@dataclass(frozen=True, slots=True)
class StepRun:
    """One executed call; ``failure`` is None for a success. ``cpu_s`` is processor time of the thread."""

    skill: Skill
    failure: FailureReason | None
    message: str
    cpu_s: float

    @property
    def ok(self) -> bool:
        return self.failure is None


@dataclass(frozen=True, slots=True)
class ModeRun:
    """What one mode made of a trial: its steps up to the first failure, and the atoms that hold in the end, as BDDL text.

    ``cpu_s`` is processor time of the whole execution, its reset included.
    """

    steps: tuple[StepRun, ...]
    atoms: frozenset[str]
    cpu_s: float

    @property
    def ok(self) -> bool:
        return all(step.ok for step in self.steps)


@dataclass(frozen=True, slots=True)
class Comparison:
    """A trial in both modes. ``bodies`` counts the objects of the scene."""

    trial: FidelityTrial
    bodies: int
    cached: ModeRun
    physical: ModeRun

    @property
    def pairs(self) -> tuple[tuple[StepRun, StepRun], ...]:
        """Steps that both modes came to. Up to the last of these all outcomes are equal."""
        return tuple(zip(self.cached.steps, self.physical.steps, strict=False))

    @property
    def steps_of_either(self) -> int:
        """Steps that at least one mode came to."""
        return max(len(self.cached.steps), len(self.physical.steps))

    @property
    def equal_steps(self) -> int:
        """Steps that both modes came to and that succeed in both, or fail in both."""
        return sum(one.ok is other.ok for one, other in self.pairs)

    @property
    def first_difference(self) -> int | None:
        """Index of the first step whose outcomes differ, None when all are equal."""
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
    """Objects of the goal and those that calls name, in the order of the table; indices outside it name none."""
    rows = {row for call in plan for row in (call.object_index, call.source_index) if row is not None}
    named = objects_of(task.goal, task.types) | {task.table[row] for row in rows if row < len(task.table)}
    return tuple(name for name in task.table if name in named)


def true_atoms(simulator: Simulator, names: Iterable[str]) -> frozenset[str]:
    """Atoms over the objects and their neighbourhood that hold in the state reached, as BDDL text."""
    facts = simulator.facts
    return frozenset(
        f"({' '.join((predicate, *args))})"
        for predicate, args in _asked(simulator, tuple(names))
        if facts.holds(predicate, args)
    )


def _asked(simulator: Simulator, names: tuple[str, ...]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Atoms that may hold: what is farther apart than ``NEAR_M`` is in no relation."""
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
        for other in world.engine.near(_grown(world.engine.aabb(name)), frozenset((name,)))
        for pair in ((name, other), (other, name))
    }
    for (one, other), relation in itertools.product(sorted(pairs), Relation):
        if relation is not Relation.INROOM:
            yield relation.value, (one, other)


def _grown(box: Aabb) -> Aabb:
    (a, b, c), (d, e, f) = box.low_m, box.high_m
    return Aabb((a - NEAR_M, b - NEAR_M, c - NEAR_M), (d + NEAR_M, e + NEAR_M, f + NEAR_M))
