"""Judging of answers: parse the texts, execute the plans, judge the results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.rpc.wire.values import Rollout
from embomatrix.skills.parse import PlanError, parse_plan
from embomatrix.skills.prompt import Codec, limited, with_indices
from embomatrix.trainer.data.tasks import group_seed
from embomatrix.trainer.evaluation.verdicts import executed_verdict, unparsable_verdict

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from embomatrix.rpc.wire.values import Outcome
    from embomatrix.skills.syntax import Plan
    from embomatrix.trainer.cluster.executor import Executor
    from embomatrix.trainer.evaluation.answers import Answer, EvaluationSetup
    from embomatrix.trainer.evaluation.benchmark import Benchmark
    from embomatrix.trainer.evaluation.verdicts import AnswerVerdict


@dataclass(frozen=True)
class JudgedAnswers:
    """Verdicts in the order of the answers, and the plans of parsable texts by (task, sample)."""

    verdicts: tuple[AnswerVerdict, ...]
    plans: Mapping[tuple[str, int], Plan]


class AnswerJudge:
    """Judge for the answers to one benchmark. ``setup`` defines the codec and the seed of the execution."""

    def __init__(self, bench: Benchmark, setup: EvaluationSetup, executor: Executor) -> None:
        self._bench = bench
        self._setup = setup
        self._executor = executor
        self._records = {record.task.task_id: record for record in bench.records}

    def judge(
        self, answers: Sequence[Answer], report: Callable[[int, int], None] = lambda done, total: None
    ) -> JudgedAnswers:
        """Judge all answers. ``report`` gets the number of executed plans and the total.

        Equal plans of a task share a seed, so they have equal outcomes and are executed once.
        """
        plans: dict[tuple[str, int], Plan] = {}
        refused: dict[tuple[str, int], AnswerVerdict] = {}
        for answer in answers:
            try:
                plans[answer.task_id, answer.sample] = self._plan(answer)
            except PlanError as error:
                refused[answer.task_id, answer.sample] = unparsable_verdict(answer, error)
        distinct = dict.fromkeys((task_id, plan) for (task_id, _), plan in plans.items())
        outcomes = self._executed(list(distinct), report)
        verdicts = []
        for answer in answers:
            key = (answer.task_id, answer.sample)
            if key in refused:
                verdicts.append(refused[key])
                continue
            task, plan = self._records[answer.task_id].task, plans[key]
            verdicts.append(executed_verdict(answer, task, plan, outcomes.get((answer.task_id, plan))))
        return JudgedAnswers(tuple(verdicts), plans)

    def _plan(self, answer: Answer) -> Plan:
        record = self._records[answer.task_id]
        text = answer.text
        if self._setup.codec == Codec.NAMES:
            situation = self._bench.tasks[answer.task_id].situation
            text = with_indices(text, limited(situation, self._setup.rows))
        return parse_plan(text, record.task.profile)

    def _executed(
        self, plans: Sequence[tuple[str, Plan]], report: Callable[[int, int], None]
    ) -> dict[tuple[str, Plan], Outcome]:
        """Outcome of each (task, plan)."""
        outcomes: dict[tuple[str, Plan], Outcome] = {}
        named = {f"plan-{number}": key for number, key in enumerate(plans)}

        def keep(rollout_id: str, outcome: Outcome) -> None:
            outcomes[named[rollout_id]] = outcome
            report(len(outcomes), len(plans))

        rollouts = [self._rollout(name, task_id, plan) for name, (task_id, plan) in named.items()]
        if rollouts:
            self._executor.execute(rollouts, keep)
        return outcomes

    def _rollout(self, name: str, task_id: str, plan: Plan) -> Rollout:
        digest = self._records[task_id].bundle_digest
        return Rollout(name, task_id, digest, task_id, plan, group_seed(self._setup.seed, task_id))
