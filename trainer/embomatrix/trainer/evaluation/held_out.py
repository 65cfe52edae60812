"""Evaluation of a policy on held-out tasks during training, with confidence intervals.

Samples of one task are not independent, so intervals come from a bootstrap over tasks.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from embomatrix.pages.figures import Interval
from embomatrix.skills.parse import PlanError
from embomatrix.skills.prompt import Codec
from embomatrix.skills.seeds import evaluation_seed
from embomatrix.skills.syntax import Plan
from embomatrix.trainer.cluster.gateway import (
    Gateway,
    PlanGroup,
    PlanOutcome,
    parse_policy_text,
    refuse_without_workers,
    result_of,
)
from embomatrix.trainer.data.tasks import TrainingTask
from embomatrix.trainer.evaluation.answers import Answer
from embomatrix.trainer.evaluation.intervals import mean_over_tasks, paired_difference
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict, executed_verdict, unparsable_verdict
from embomatrix.trainer.learning.learner import Learner, SamplingParams
from embomatrix.trainer.policy.prompts import PromptBuilder, TaskPrompt
from embomatrix.trainer.serving.sampler import Draw, ServerSampler, begin_drawing

if TYPE_CHECKING:
    from embomatrix.trainer.config.settings import EvaluationSettings
    from embomatrix.trainer.learning.data_parallel import DataParallelWorkers, RemoteLearner


@dataclass(frozen=True, slots=True)
class TaskScore:
    """Samples of one task. ``lost`` rollouts count in neither ``samples`` nor ``successes``."""

    task_id: str
    category: str
    samples: int
    successes: int
    lost: int

    @property
    def rate(self) -> float:
        return self.successes / self.samples if self.samples else float("nan")


@dataclass(frozen=True, slots=True)
class HeldOutAnswer:
    """Sampled text of a held-out task, its verdict, and its plan, empty if it holds none."""

    text: str
    verdict: AnswerVerdict
    plan: Plan = ()


@dataclass(frozen=True)
class HeldOutEvaluation:
    """Scores of all tasks, in task order, with the sampled plans. Checkpoints keep the scores only."""

    scores: tuple[TaskScore, ...]
    answers: tuple[HeldOutAnswer, ...] = ()

    def success(self, category: str = "") -> Interval:
        """Mean success over the tasks of one category, or of all."""
        rates = [score.rate for score in self.scores if category in ("", score.category)]
        return mean_over_tasks(rates).interval

    @property
    def categories(self) -> tuple[str, ...]:
        return tuple(sorted({score.category for score in self.scores}))

    def as_json(self) -> list[dict[str, Any]]:
        return [asdict(score) for score in self.scores]

    @staticmethod
    def from_json(values: Sequence[Mapping[str, Any]]) -> HeldOutEvaluation:
        return HeldOutEvaluation(tuple(TaskScore(**value) for value in values))


def improvement(before: HeldOutEvaluation, after: HeldOutEvaluation) -> Interval:
    """Mean paired difference in success over the tasks in both evaluations."""
    earlier, later = ({score.task_id: score.rate for score in each.scores} for each in (before, after))
    return paired_difference(earlier, later)


_Submitted = tuple[PlanGroup, Future[tuple[PlanOutcome, ...]]]


def evaluate_policy(
    workers: DataParallelWorkers,
    prompt_builder: PromptBuilder,
    tasks: Sequence[TrainingTask],
    gateway: Gateway,
    settings: EvaluationSettings,
    *,
    samples: int,
    max_new: int,
    seed: int,
    label: str,
    report: Callable[[int, int], None],
    server: ServerSampler | None = None,
) -> HeldOutEvaluation:
    """Sample plans of each task and execute each once. The workers sample, unless there is a model ``server``.

    ``report`` gets finished and total tasks.

    A chunk of tasks has its own seed, so its plans are the same in whichever process they are sampled. Raises TrainerError if
    the cluster failed, or no worker took any plan.
    """
    codec, rule = workers.local.policy.codec, SamplingParams(samples, settings.temperature, max_new)
    chunks = [tasks[at : at + settings.chunk] for at in range(0, len(tasks), settings.chunk)]
    gateway.announce(dict(enumerate(chunks)), samples)
    # Without this report a display would show the phase before until the first plans are sampled and executed.
    report(0, len(tasks))
    collected = _Collected(codec, lambda done: report(done, len(tasks)))

    def sample(
        number: int,
        chunk: Sequence[TrainingTask],
        prompts: Sequence[TaskPrompt],
        draw: Draw,
        learner: Learner | RemoteLearner,
    ) -> None:
        drawn = draw(learner)
        groups = [
            PlanGroup(
                task,
                prompt.situation,
                drawn.texts[row * samples : (row + 1) * samples],
                evaluation_seed(seed, task.task.task_id),
            )
            for row, (task, prompt) in enumerate(zip(chunk, prompts, strict=True))
        ]
        futures = gateway.submit(f"{label}-{number}", number, groups, codec)
        collected.submitted[number] = deque(zip(groups, futures, strict=True))
        if learner is workers.local:  # on the thread of the caller
            collected.take_finished()

    jobs = []
    for number, chunk in enumerate(chunks):
        prompts = [prompt_builder.plain(task) for task in chunk]
        draw = begin_drawing(server, [prompt.tokens for prompt in prompts], chunk_seed(seed, number), rule)
        jobs.append((number, functools.partial(sample, number, chunk, prompts, draw)))
    workers.map(jobs)
    collected.take_all()
    refuse_without_workers(collected.outcomes, f"the evaluation on {len(tasks)} tasks")
    return HeldOutEvaluation(tuple(collected.scores), tuple(collected.answers))


@dataclass(slots=True)
class _Collected:
    """Groups whose outcomes were not taken yet, by chunk, and scores and answers of the others, in the order of the chunks."""

    codec: Codec
    report: Callable[[int], None]
    """Gets the number of tasks whose outcomes were taken."""
    submitted: dict[int, deque[_Submitted]] = field(default_factory=dict)
    chunk: int = 0
    """Chunk whose outcomes are taken next."""
    outcomes: list[PlanOutcome] = field(default_factory=list)
    scores: list[TaskScore] = field(default_factory=list)
    answers: list[HeldOutAnswer] = field(default_factory=list)

    def take_finished(self) -> None:
        """Take the outcomes of the oldest groups that are executed, without waiting."""
        while self.chunk in self.submitted:
            groups = self.submitted[self.chunk]
            while groups and groups[0][1].done():
                self._take(*groups.popleft())
            if groups:
                return
            self.chunk += 1

    def take_all(self) -> None:
        """Wait for the outcomes of all groups and take them. Every chunk must be submitted."""
        for number in range(self.chunk, len(self.submitted)):
            for group, future in self.submitted[number]:
                self._take(group, future)

    def _take(self, group: PlanGroup, future: Future[tuple[PlanOutcome, ...]]) -> None:
        outcomes = result_of(future)
        self.outcomes += outcomes
        self.scores.append(task_score(group.task, outcomes))
        self.answers += [_answer(group, self.codec, sample, each) for sample, each in enumerate(outcomes)]
        self.report(len(self.scores))


def chunk_seed(seed: int, chunk: int) -> int:
    """Return the seed of a chunk's plans."""
    return int(np.random.SeedSequence((seed, chunk)).generate_state(1)[0])


def _answer(group: PlanGroup, codec: Codec, sample: int, outcome: PlanOutcome) -> HeldOutAnswer:
    answer = Answer(group.task.task.task_id, sample, outcome.text)
    try:
        plan = parse_policy_text(outcome.text, group.situation, codec)
    except PlanError as error:
        return HeldOutAnswer(outcome.text, unparsable_verdict(answer, error))
    verdict = executed_verdict(answer, group.task.task, plan, outcome.outcome)
    return HeldOutAnswer(outcome.text, verdict, plan)


def task_score(task: TrainingTask, outcomes: Sequence[PlanOutcome]) -> TaskScore:
    """Score of a task from the outcomes of its samples."""
    known = [outcome for outcome in outcomes if outcome.reward is not None]
    return TaskScore(
        task_id=task.task.task_id,
        category=task.task.category.value,
        samples=len(known),
        successes=sum(outcome.success for outcome in known),
        lost=len(outcomes) - len(known),
    )
