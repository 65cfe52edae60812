"""Admission requires that the oracle's plan reaches a goal that does not hold at the start."""

import pytest

from embomatrix.factory.admission import RefusalReason, TaskRefusal, admit
from embomatrix.sim.planner.oracle import PlanNotFound
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Plan, Skill, SkillCall
from embomatrix.skills.trace import Step, Trace
from embomatrix.world.bddl import InitLiteral, parse_formula
from embomatrix.world.goal import Atom
from embomatrix.world.task import Task, TaskCategory

NAMES = {"box_1": "box", "box_2": "box", "box_3": "box", "lamp_1": "lamp"}
OPEN_1 = SkillCall(Skill.OPEN, object_index=0)
OPEN_2 = SkillCall(Skill.OPEN, object_index=1)


def task(goal: str) -> Task:
    formula = parse_formula(goal, NAMES)
    types = {"box": ("box_1", "box_2", "box_3")}
    return Task("t", "s", "", TaskCategory.APPLIANCE_USE, formula, goal, tuple(NAMES), types)


class Boxes:
    """Executor that supports only ``open``."""

    def __init__(self, *opened: str) -> None:
        self._start = set(opened)
        self._open = set(opened)

    @property
    def facts(self) -> "Boxes":
        return self

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        return predicate == "open" and args[0] in self._open

    def execute(self, task: Task, plan: Plan, seed: int) -> Trace:
        self._open = set(self._start)
        steps: list[Step] = []
        for call in plan:
            failure = None if call.skill is Skill.OPEN else FailureReason.NOT_TOGGLEABLE
            steps.append(Step(call, failure, "opened" if failure is None else "it has no switch"))
            if failure is not None:
                break
            self._open.add(task.table[call.object_index or 0])
        return Trace(plan, tuple(steps), frozenset(self._open), (), "")


class Stuck(Boxes):
    """Boxes that a robot can't open, although it may believe that they are open."""

    def __init__(self, *, says_so: bool = True) -> None:
        super().__init__()
        self._failure = FailureReason.ARM_BLOCKED if says_so else None

    def execute(self, task: Task, plan: Plan, seed: int) -> Trace:
        self._open = set()
        steps = tuple(Step(call, self._failure, "box_2 bars it") for call in plan[:1])
        return Trace(plan, steps, frozenset(), (), "")


def oracle(*plan: SkillCall):
    return lambda _stage, _task: plan


def test_task_solved_by_the_oracle_is_admitted_with_its_plan() -> None:
    verdict = admit(Boxes(), task("(and (open box_1) (open box_2))"), oracle(OPEN_1, OPEN_2))
    assert verdict == (OPEN_1, OPEN_2)


def test_half_of_the_atoms_may_hold_at_the_start() -> None:
    verdict = admit(Boxes("box_2"), task("(and (open box_1) (open box_2))"), oracle(OPEN_1))
    assert verdict == (OPEN_1,)


@pytest.mark.parametrize(
    ("stage", "goal", "plan", "reason"),
    [
        (Boxes("box_1"), "(open box_1)", (OPEN_1,), RefusalReason.GOAL_HOLDS),
        (Boxes(), "(not (open box_1))", (OPEN_1,), RefusalReason.GOAL_HOLDS),
        (
            Boxes("box_2", "box_3"),
            "(forall (?b - box) (open ?b))",
            (OPEN_1,),
            RefusalReason.MOSTLY_DONE,
        ),
        (Boxes(), "(open box_1)", (OPEN_2,), RefusalReason.ORACLE_FAILED),
        (Boxes(), "(open box_1)", (), RefusalReason.ORACLE_FAILED),
        (
            Boxes(),
            "(open box_1)",
            (OPEN_1, SkillCall(Skill.TOGGLE_ON, object_index=3)),
            RefusalReason.ORACLE_FAILED,
        ),
    ],
)
def test_task_is_refused_with_one_reason(stage: Boxes, goal: str, plan: Plan, reason: RefusalReason) -> None:
    verdict = admit(stage, task(goal), oracle(*plan))
    assert isinstance(verdict, TaskRefusal)
    assert verdict.reason is reason
    assert len(verdict.sentence) > 20


def test_plan_that_fails_in_physics_is_refused_with_the_failed_step() -> None:
    goal = task("(open box_1)")
    assert admit(Boxes(), goal, oracle(OPEN_1), physics=Boxes()) == (OPEN_1,)
    verdict = admit(Boxes(), goal, oracle(OPEN_1), physics=Stuck())
    assert verdict == TaskRefusal(
        RefusalReason.PHYSICS_FAILED,
        "the oracle's plan fails in stepped physics: arm_blocked: step 1, open: box_2 bars it",
    )
    unmoved = admit(Boxes(), goal, oracle(OPEN_1), physics=Stuck(says_so=False))
    assert isinstance(unmoved, TaskRefusal)
    assert "the goal does not hold at the end" in unmoved.sentence


def test_planner_reason_is_passed_on() -> None:
    verdict = admit(
        Boxes(), task("(open box_1)"), lambda _stage, _task: PlanNotFound("box_1 is behind a wall")
    )
    assert verdict == TaskRefusal(
        RefusalReason.NO_PLAN, "the oracle planner found no plan: box_1 is behind a wall"
    )


def test_unmet_start_atom_is_refused() -> None:
    init = (InitLiteral(Atom("open", ("box_1",)), positive=False), InitLiteral(Atom("open", ("box_2",))))
    verdict = admit(Boxes("box_1"), task("(open box_3)"), oracle(OPEN_1), init)
    assert isinstance(verdict, TaskRefusal)
    assert verdict.reason is RefusalReason.INIT_NOT_MET
    assert "(not (open box_1))" in verdict.sentence


def test_benchmark_may_hold_more_than_half_but_not_all_atoms_at_the_start() -> None:
    goal = task("(and (open box_1) (open box_2) (open box_3))")
    held = Boxes("box_1", "box_2")
    opened = oracle(SkillCall(Skill.OPEN, object_index=goal.index_of["box_3"]))
    usual = admit(held, goal, opened)
    assert isinstance(usual, TaskRefusal)
    assert "2 of 3 atoms hold at the start, expected at most 50%" in usual.sentence
    assert admit(held, goal, opened, most_held=1.0) == opened(held, goal)
    done = admit(Boxes("box_1", "box_2", "box_3"), goal, opened, most_held=1.0)
    assert isinstance(done, TaskRefusal)
    assert done.reason is RefusalReason.GOAL_HOLDS
