"""From answers to verdicts: texts are parsed, plans are executed wherever there are simulators, results are judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from embomatrix.rpc.wire.values import Rollout
from embomatrix.skills.parse import PlanError, parse_plan
from embomatrix.skills.prompt import Codec, limited, with_indices
from embomatrix.trainer.data.tasks import group_seed
from embomatrix.trainer.evaluation.verdicts import of_plan, of_text

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from embomatrix.rpc.wire.values import Outcome
    from embomatrix.skills.syntax import Plan
    from embomatrix.trainer.evaluation.answers import Answer, EvaluationSetup
    from embomatrix.trainer.evaluation.benchmark import Benchmark
    from embomatrix.trainer.evaluation.verdicts import AnswerVerdict

    OnResult = Callable[[str, Outcome], None]


class Executor(Protocol):
    """Where plans are executed: a cluster, or processes of this machine. Both give equal outcomes."""

    def execute(self, rollouts: Sequence[Rollout], on_result: OnResult) -> None:
        """Execute each once; ``on_result`` gets a rollout's id and its one outcome. Raises ClusterError."""
        ...


@dataclass(frozen=True)
class JudgedAnswers:
    """A verdict for each answer, in their order, and by (task, sample) the plans of those texts that are one."""

    verdicts: tuple[AnswerVerdict, ...]
    plans: Mapping[tuple[str, int], Plan]


class AnswerJudge:
    """Judges the answers to one benchmark. ``setup`` says how they name objects, and seeds the execution."""

    def __init__(self, bench: Benchmark, setup: EvaluationSetup, executor: Executor) -> None:
        self._bench = bench
        self._setup = setup
        self._executor = executor
        self._records = {record.task.task_id: record for record in bench.records}

    def judge(
        self, answers: Sequence[Answer], report: Callable[[int, int], None] = lambda done, total: None
    ) -> JudgedAnswers:
        """Judge every answer. ``report`` is told of plans executed and in all.

        Equal plans of a task are executed once: they share a seed, so their outcomes are equal.
        """
        plans: dict[tuple[str, int], Plan] = {}
        refused: dict[tuple[str, int], AnswerVerdict] = {}
        for answer in answers:
            try:
                plans[answer.task_id, answer.sample] = self._plan(answer)
            except PlanError as error:
                refused[answer.task_id, answer.sample] = of_text(answer, error)
        distinct = dict.fromkeys((task_id, plan) for (task_id, _), plan in plans.items())
        outcomes = self._executed(list(distinct), report)
        verdicts = []
        for answer in answers:
            key = (answer.task_id, answer.sample)
            if key in refused:
                verdicts.append(refused[key])
                continue
            task, plan = self._records[answer.task_id].task, plans[key]
            verdicts.append(of_plan(answer, task, plan, outcomes.get((answer.task_id, plan))))
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
        """The outcome of each (task, plan)."""
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
