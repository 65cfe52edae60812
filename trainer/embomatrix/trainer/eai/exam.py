"""EAI-native as an exam: EAI's own prompts and vocabulary, judged by its published judge. Our simulator has no part in it."""

from __future__ import annotations

import hashlib
import json
from functools import cached_property
from typing import TYPE_CHECKING, Final

from embomatrix.skills.prompt import Prompt
from embomatrix.trainer.eai.environment import PACKAGE
from embomatrix.trainer.evaluation.exam import Marked, Question
from embomatrix.trainer.evaluation.intervals import mean_over_tasks
from embomatrix.trainer.evaluation.scoreboard import Scoreboard
from embomatrix.trainer.evaluation.taxonomy import Cause
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict
from embomatrix.world.task import TaskCategory

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from embomatrix.skills.prompt import Codec
    from embomatrix.trainer.eai.judge import NativeJudge, NativeResult, NativeTask
    from embomatrix.trainer.evaluation.answers import Answer, EvaluationSetup
    from embomatrix.trainer.evaluation.intervals import Estimate

NAME: Final = "eai-native"
CODEC: Final = "eai"
_KINDS: Final[Mapping[str, Cause]] = {
    "parsing": Cause.UNPARSABLE,
    "arguments": Cause.WRONG_ARGUMENT,
    "unknown_execution": Cause.HALLUCINATED_SKILL,
    "ErrorType.AFFORDANCE_ERROR": Cause.AFFORDANCE,
    "ErrorType.WRONG_TEMPORAL_ORDER": Cause.WRONG_ORDER,
    "ErrorType.MISSING_STEP": Cause.MISSING_STEP,
}
"""The judge's own kinds of error as our causes. ADDITIONAL_STEP stops no plan there."""
_HALLUCINATION: Final = "hullucination"
"""As the package spells it; its words begin with what was made up: an action or an object."""


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
        told = json.dumps(
            [PACKAGE, *((task.demo, task.prompt, task.category) for task in self._tasks.values())]
        )
        return f"sha256:{hashlib.sha256(told.encode()).hexdigest()}"

    def questions(self, codec: Codec, rows: int) -> tuple[Question, ...]:
        """EAI's prompts as they are published; neither argument changes them."""
        return tuple(Question(task.demo, Prompt("", task.prompt)) for task in self._tasks.values())

    def human(self, task_id: str) -> str:
        """The human plan that the package publishes."""
        return self._tasks[task_id].human

    def judge(
        self, setup: EvaluationSetup, answers: Sequence[Answer], report: Callable[[int, int], None]
    ) -> Marked:
        """Equal answers of a task are judged once. Raises TrainerError where the judge can't start."""
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
        return Marked(board, (), others)


def _share(
    results: Sequence[tuple[Answer, NativeResult | None]], of: Callable[[NativeResult], bool]
) -> Estimate:
    """Mean over tasks of the share of answers."""
    by_task: dict[str, list[bool]] = {}
    for answer, result in results:
        if result is not None:
            by_task.setdefault(answer.task_id, []).append(of(result))
    return mean_over_tasks([sum(values) / len(values) for values in by_task.values()])


def _verdict(answer: Answer, result: NativeResult | None) -> AnswerVerdict:
    """An answer that the judge did not survive is lost: it is no evidence. ``partial`` is over the goal's conjuncts."""
    if result is None:
        return AnswerVerdict(answer.task_id, answer.sample, success=False, partial=0.0, lost=True)
    partial = sum(result.goals) / len(result.goals) if result.goals else 0.0
    cause, reason = (None, "") if result.official else _cause(result)
    return AnswerVerdict(
        answer.task_id, answer.sample, success=result.official, partial=partial, cause=cause, reason=reason
    )


def _cause(result: NativeResult) -> tuple[Cause, str]:
    told = result.errors.get(_HALLUCINATION)
    if told is not None:
        made_up = Cause.HALLUCINATED_OBJECT if told.startswith("object") else Cause.HALLUCINATED_SKILL
        return made_up, ""
    for kind, cause in _KINDS.items():
        if kind in result.errors and not result.executed:
            return cause, ""
    return (Cause.GOAL_NOT_MET, "choices_cut_short") if result.exact else (Cause.GOAL_NOT_MET, "")
