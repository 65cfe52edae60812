"""Judging of answers: parse the texts, execute the plans, judge the results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.rpc.wire.values import Outcome, Rollout
from embomatrix.skills.parse import PlanError, parse_plan
from embomatrix.skills.prompt import Codec, limited, with_indices
from embomatrix.skills.seeds import evaluation_seed
from embomatrix.skills.syntax import Plan
from embomatrix.trainer.cluster.executor import Executor
from embomatrix.trainer.evaluation.benchmark import Benchmark
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict, executed_verdict, unparsable_verdict
from embomatrix.world.task import Profile

if TYPE_CHECKING:
    from embomatrix.trainer.evaluation.answers import Answer, EvaluationSetup


@dataclass(frozen=True)
class JudgedAnswers:
    """Verdicts in the order of the answers, and the plans of parsable texts by (task, sample)."""

    verdicts: tuple[AnswerVerdict, ...]
    plans: Mapping[tuple[str, int], Plan]


def judge_answers(
    bench: Benchmark,
    setup: EvaluationSetup,
    executor: Executor,
    answers: Sequence[Answer],
    report: Callable[[int, int], None] = lambda done, total: None,
) -> JudgedAnswers:
    """Judge the answers to a benchmark. ``report`` gets the number of executed plans and the total.

    ``setup`` defines the codec and the seed of the execution. Equal plans of a task share a seed, so they have equal
    outcomes and are executed once.
    """
    records = {record.task.task_id: record for record in bench.records}
    plans: dict[tuple[str, int], Plan] = {}
    unparsable: dict[tuple[str, int], AnswerVerdict] = {}
    for answer in answers:
        key = (answer.task_id, answer.sample)
        try:
            plans[key] = _parse(bench, setup, answer, records[answer.task_id].task.profile)
        except PlanError as error:
            unparsable[key] = unparsable_verdict(answer, error)
    distinct = dict.fromkeys((task_id, plan) for (task_id, _), plan in plans.items())
    names = {f"plan-{number}": key for number, key in enumerate(distinct)}
    outcomes: dict[tuple[str, Plan], Outcome] = {}

    def on_result(rollout_id: str, outcome: Outcome) -> None:
        outcomes[names[rollout_id]] = outcome
        report(len(outcomes), len(names))

    rollouts = [
        Rollout(
            name, task_id, records[task_id].bundle_digest, task_id, plan, evaluation_seed(setup.seed, task_id)
        )
        for name, (task_id, plan) in names.items()
    ]
    if rollouts:
        executor.execute(rollouts, on_result)
    verdicts = []
    for answer in answers:
        key = (answer.task_id, answer.sample)
        if key in unparsable:
            verdicts.append(unparsable[key])
        else:
            outcome = outcomes.get((answer.task_id, plans[key]))
            verdicts.append(executed_verdict(answer, records[answer.task_id].task, plans[key], outcome))
    return JudgedAnswers(tuple(verdicts), plans)


def _parse(bench: Benchmark, setup: EvaluationSetup, answer: Answer, profile: Profile) -> Plan:
    text = answer.text
    if setup.codec == Codec.NAMES:
        text = with_indices(text, limited(bench.tasks[answer.task_id].situation, setup.rows))
    return parse_plan(text, profile)
