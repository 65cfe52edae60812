"""Admission: the simulator decides whether a task enters a dataset.

The goal must not hold at the start, and at most half of its atoms may (published benchmarks have other limits). The
oracle planner must find a plan that earns full success when it is executed, optionally also by a robot in stepped
physics. A refusal is a value with a reason.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol, TypeVar

from embomatrix.reward.hierarchy import score
from embomatrix.sim.planner.oracle import PlanNotFound
from embomatrix.skills.parse import PlanError, plan_from_json
from embomatrix.skills.syntax import Plan
from embomatrix.skills.trace import Trace
from embomatrix.world.bddl import InitLiteral
from embomatrix.world.dataset import DatasetError, TaskRecord
from embomatrix.world.evaluate import evaluate, render, scored_atoms
from embomatrix.world.goal import Facts, Not
from embomatrix.world.task import Task


class RefusalReason(StrEnum):
    """Reasons in the order of the checks: three for drafts, eleven for bindings, the rest for admission."""

    NO_ANSWER = "no_answer"
    UNUSABLE_ANSWER = "unusable_answer"
    UNFAITHFUL = "unfaithful"
    UNPARSABLE = "unparsable"
    UNKNOWN_TYPE = "unknown_type"
    SUBSTANCE = "substance"
    INEXPRESSIBLE = "inexpressible"
    ROOM_MISSING = "room_missing"
    ROOM_AS_OBJECT = "room_as_object"
    AGENT_IN_GOAL = "agent_in_goal"
    NO_SCENE_OBJECT = "no_scene_object"
    DOES_NOT_FIT = "does_not_fit"
    NO_PLACE_GIVEN = "no_place_given"
    TABLE_TOO_LONG = "table_too_long"
    INIT_NOT_MET = "init_not_met"
    GOAL_HOLDS = "goal_holds"
    MOSTLY_DONE = "mostly_done"
    NO_PLAN = "no_plan"
    ORACLE_FAILED = "oracle_failed"
    PHYSICS_FAILED = "physics_failed"
    SHORTCUT = "shortcut"
    HIDDEN_OBSTACLE = "hidden_obstacle"


@dataclass(frozen=True, slots=True)
class TaskRefusal:
    """Refused task: the reason, and a sentence about the case. ``about`` is the problem's object at fault, if one is."""

    reason: RefusalReason
    sentence: str
    about: str = ""


class RefusedError(Exception):
    """Refusal raised inside a binding. Callers of the import get the refusal as a value."""

    def __init__(self, reason: RefusalReason, sentence: str, about: str = "") -> None:
        super().__init__(sentence)
        self.refusal = TaskRefusal(reason, sentence, about)


SEED: Final = 0
"""Seed of the executions that verify a task."""
MAX_HELD_SHARE: Final = 0.5
"""Share of a goal's atoms that may hold at the start. Atoms such as "leave it closed" may only accompany others."""


class PlanExecutor(Protocol):
    """Executor of plans: ``sim.executor.Simulator``, or a table in a test."""

    @property
    def facts(self) -> Facts: ...

    def execute(self, task: Task, plan: Plan, seed: int) -> Trace: ...


S = TypeVar("S", bound=PlanExecutor)


def oracle_plan(record: TaskRecord) -> Plan:
    """Return the record's oracle plan. Raise DatasetError if it can't be read."""
    task = record.task
    try:
        return plan_from_json(list(record.oracle), task.profile)
    except PlanError as error:
        raise DatasetError(
            f"the oracle plan of task {task.task_id!r} can't be read: {error}; build the dataset again"
        ) from error


def admit(
    executor: S,
    task: Task,
    find_plan: Callable[[S, Task], Plan | PlanNotFound],
    init: Sequence[InitLiteral] = (),
    *,
    most_held: float = MAX_HELD_SHARE,
    physics: PlanExecutor | None = None,
) -> Plan | TaskRefusal:
    """Judge a task by execution. Return a plan that reaches its goal, or a refusal.

    ``init`` lists atoms that must hold at the start according to the task's source.
    At most the share ``most_held`` of the goal's atoms may hold at the start; 1 means all but one. If ``physics`` is
    given, the plan must also reach the goal there.
    """
    executor.execute(task, (), SEED)
    for literal in init:
        if executor.facts.holds(literal.atom.predicate, literal.atom.args) is not literal.positive:
            wanted = render(literal.atom if literal.positive else Not(literal.atom))
            return TaskRefusal(
                RefusalReason.INIT_NOT_MET, f"{wanted} does not hold in the scene that was built"
            )
    if evaluate(task.goal, executor.facts, task.types):
        return TaskRefusal(RefusalReason.GOAL_HOLDS, f"the goal holds at the start: {task.goal_bddl}")
    atoms = scored_atoms(task.goal, task.types)
    held = tuple(render(atom) for atom in atoms if evaluate(atom, executor.facts, task.types))
    if len(held) > most_held * len(atoms):
        return TaskRefusal(
            RefusalReason.MOSTLY_DONE,
            f"{len(held)} of {len(atoms)} atoms hold at the start, expected at most {most_held:.0%}: {' '.join(held)}",
        )
    plan = find_plan(executor, task)
    if isinstance(plan, PlanNotFound):
        return TaskRefusal(RefusalReason.NO_PLAN, f"the oracle planner found no plan: {plan.reason}")
    trace = executor.execute(task, plan, SEED)
    reward = score(task, trace.touched, executor.facts)
    if trace.failure is not None or not reward.success:
        last = trace.steps[-1].message if trace.steps else "the plan is empty"
        return TaskRefusal(RefusalReason.ORACLE_FAILED, f"the oracle's plan earns {reward.total:.1f}: {last}")
    failure = plan_failure(physics, task, plan) if physics is not None else None
    if failure is not None:
        return TaskRefusal(
            RefusalReason.PHYSICS_FAILED, f"the oracle's plan fails in stepped physics: {failure}"
        )
    return plan


@dataclass(frozen=True, slots=True)
class PlanFailure:
    """Failure of an executed plan. ``reason``: failure reason of its last step, or ``goal_missed``."""

    reason: str
    detail: str

    def __str__(self) -> str:
        return f"{self.reason}: {self.detail}"


def plan_failure(executor: PlanExecutor, task: Task, plan: Plan) -> PlanFailure | None:
    """Execute a plan and return its failure, None if it reaches the goal."""
    trace = executor.execute(task, plan, SEED)
    if trace.failure is None:
        reached = score(task, trace.touched, executor.facts).success
        missed = PlanFailure("goal_missed", "every step succeeds, but the goal does not hold at the end")
        return None if reached else missed
    last = trace.steps[-1]
    return PlanFailure(trace.failure.value, f"step {len(trace.steps)}, {last.call.skill}: {last.message}")
