"""EAI-native exam: EAI's own prompts and vocabulary, judged by its published judge. Our simulator is not involved."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Final

from embomatrix.skills.prompt import Codec, Prompt
from embomatrix.trainer.eai.environment import PACKAGE
from embomatrix.trainer.eai.judge import NativeJudge, NativeResult, NativeTask
from embomatrix.trainer.evaluation.exam import ExamResult, Question
from embomatrix.trainer.evaluation.intervals import Estimate, mean_over_tasks
from embomatrix.trainer.evaluation.scoreboard import Scoreboard
from embomatrix.trainer.evaluation.taxonomy import Cause
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict
from embomatrix.world.task import TaskCategory

if TYPE_CHECKING:
    from embomatrix.trainer.evaluation.answers import Answer, EvaluationSetup

NAME: Final = "eai-native"
CODEC: Final = "eai"
_CAUSES: Final[Mapping[str, Cause]] = {
    "parsing": Cause.UNPARSABLE,
    "arguments": Cause.WRONG_ARGUMENT,
    "unknown_execution": Cause.HALLUCINATED_SKILL,
    "ErrorType.AFFORDANCE_ERROR": Cause.AFFORDANCE,
    "ErrorType.WRONG_TEMPORAL_ORDER": Cause.WRONG_ORDER,
    "ErrorType.MISSING_STEP": Cause.MISSING_STEP,
}
"""Causes for the judge's kinds of error. ADDITIONAL_STEP does not stop a plan there."""
_HALLUCINATION: Final = "hullucination"
"""Spelled as in the package. The message starts with the kind of the invented name: action or object."""


class NativeExam:
    """The hundred tasks of EAI's BEHAVIOR split."""

    name = NAME
    split = "all"
    by_rule = 0

    def __init__(self, judge: NativeJudge) -> None:
        self._judge = judge

    @cached_property
    def _tasks(self) -> Mapping[str, NativeTask]:
        return {task.demo: task for task in self._judge.tasks()}

    @cached_property
    def task_ids(self) -> tuple[str, ...]:
        return tuple(self._tasks)

    @cached_property
    def digest(self) -> str:
        content = json.dumps(
            [PACKAGE, *((task.demo, task.prompt, task.category) for task in self._tasks.values())]
        )
        return f"sha256:{hashlib.sha256(content.encode()).hexdigest()}"

    def questions(self, codec: Codec, rows: int) -> tuple[Question, ...]:
        """EAI's published prompts. Neither argument changes them."""
        return tuple(Question(task.demo, Prompt("", task.prompt)) for task in self._tasks.values())

    def human(self, task_id: str) -> str:
        """Return the human plan that the package publishes."""
        return self._tasks[task_id].human

    def judge(
        self, setup: EvaluationSetup, answers: Sequence[Answer], report: Callable[[int, int], None]
    ) -> ExamResult:
        """Judge answers; equal answers of a task are judged once. Raises TrainerError if the judge can't start."""
        categories = {task.demo: TaskCategory(task.category) for task in self._tasks.values()}
        known: dict[tuple[str, str], NativeResult | None] = {}
        results = []
        for number, answer in enumerate(answers, start=1):
            key = (answer.task_id, answer.text)
            if key not in known:
                known[key] = self._judge.judge(*key)
            results.append((answer, known[key]))
            report(number, len(answers))
        board = Scoreboard.of(categories, [_verdict(answer, result) for answer, result in results])
        others = {
            "goal exactly true and executed": _share(results, lambda result: result.exact),
            "executed to the end": _share(results, lambda result: result.executed),
        }
        return ExamResult(board, (), others)


def _share(
    results: Sequence[tuple[Answer, NativeResult | None]], of: Callable[[NativeResult], bool]
) -> Estimate:
    """Mean over tasks of the share of answers with the property."""
    by_task: dict[str, list[bool]] = {}
    for answer, result in results:
        if result is not None:
            by_task.setdefault(answer.task_id, []).append(of(result))
    return mean_over_tasks([sum(values) / len(values) for values in by_task.values()])


def _verdict(answer: Answer, result: NativeResult | None) -> AnswerVerdict:
    """Verdict on an answer. Without a result it counts as lost. ``partial`` is the share of the goal's conjuncts."""
    if result is None:
        return AnswerVerdict(answer.task_id, answer.sample, success=False, partial=0.0, lost=True)
    partial = sum(result.goals) / len(result.goals) if result.goals else 0.0
    cause, reason = (None, "") if result.official else _cause(result)
    return AnswerVerdict(
        answer.task_id, answer.sample, success=result.official, partial=partial, cause=cause, reason=reason
    )


def _cause(result: NativeResult) -> tuple[Cause, str]:
    hallucination = result.errors.get(_HALLUCINATION)
    if hallucination is not None:
        cause = Cause.HALLUCINATED_OBJECT if hallucination.startswith("object") else Cause.HALLUCINATED_SKILL
        return cause, ""
    for kind, cause in _CAUSES.items():
        if kind in result.errors and not result.executed:
            return cause, ""
    return (Cause.GOAL_NOT_MET, "choices_cut_short") if result.exact else (Cause.GOAL_NOT_MET, "")
