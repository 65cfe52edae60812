"""Verdict on one answer: success, partial credit, and the cause of failure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.rpc.wire.values import Completed, Outcome
from embomatrix.skills.parse import PlanError
from embomatrix.skills.syntax import Plan
from embomatrix.trainer.evaluation.taxonomy import PLAN_CAUSES, Cause, cause_of_trace
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.trainer.evaluation.answers import Answer


@dataclass(frozen=True, slots=True)
class AnswerVerdict:
    """Verdict on one answer.

    ``partial`` is the share of goal atoms that hold at the end, 0 for unparsable text. ``cause`` is None for a success.
    ``step`` is the number of the failed step from 1, 0 if none failed; a goal may hold in spite of a failed step. ``reason`` (a
    ``PlanReason`` or ``FailureReason``) and ``sentence`` come from the step or the parser. ``done`` of the plan's ``steps``
    succeeded. ``lost``: the infrastructure lost the result, which says nothing about the plan.
    """

    task_id: str
    sample: int
    success: bool
    partial: float
    cause: Cause | None = None
    reason: str = ""
    step: int = 0
    sentence: str = ""
    steps: int = 0
    done: int = 0
    lost: bool = False


def unparsable_verdict(answer: Answer, error: PlanError) -> AnswerVerdict:
    """Verdict on a text without a valid plan, which is not executed."""
    return AnswerVerdict(
        answer.task_id,
        answer.sample,
        success=False,
        partial=0.0,
        cause=PLAN_CAUSES[error.reason],
        reason=error.reason.value,
        sentence=str(error),
    )


def executed_verdict(answer: Answer, task: Task, plan: Plan, outcome: Outcome | None) -> AnswerVerdict:
    """Verdict on an executed or lost plan."""
    if not isinstance(outcome, Completed):
        return AnswerVerdict(
            answer.task_id, answer.sample, success=False, partial=0.0, steps=len(plan), lost=True
        )
    reward, steps = outcome.reward, outcome.steps
    partial = sum(atom.holds for atom in reward.atoms) / len(reward.atoms) if reward.atoms else 0.0
    done = sum(step.ok for step in steps)
    last = steps[-1] if steps else None
    failure = last.failure if last is not None else None
    return AnswerVerdict(
        answer.task_id,
        answer.sample,
        success=reward.success,
        partial=partial,
        cause=None if reward.success else cause_of_trace(plan, steps, task.table),
        reason=failure.value if failure is not None else "",
        step=len(steps) if failure is not None else 0,
        sentence=last.message if last is not None and failure is not None else "",
        steps=len(plan),
        done=done,
    )
