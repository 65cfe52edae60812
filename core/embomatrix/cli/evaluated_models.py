"""Models that `embomatrix eval` asks: one in this process, an endpoint or a baseline, ready to answer.

torch is imported only for a model in this process.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.scripts.searching import PlacePriors
from embomatrix.skills.parse import plan_to_json
from embomatrix.skills.prompt import Codec
from embomatrix.starter.shipped import open_dataset
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import read_tasks
from embomatrix.trainer.eai.exam import NAME as NATIVE
from embomatrix.trainer.eai.exam import NativeExam
from embomatrix.trainer.evaluation.answer_sources import (
    OnProgress,
    ask_endpoint,
    ask_policy,
    seed_of,
)
from embomatrix.trainer.evaluation.answers import AnswerSheet
from embomatrix.trainer.evaluation.baselines import PLANNERS, SCRIPTS, BaselineName, fitted_scripts
from embomatrix.trainer.evaluation.episodes import (
    EpisodeAgent,
    EpisodeExam,
    PlanAgent,
    SearchingAgent,
    ask_endpoint_in_episodes,
    play_episodes,
)
from embomatrix.trainer.evaluation.exam import Question, WorldExam
from embomatrix.trainer.policy.limits import ANSWER_TOKENS, TokenCounter, check_context, room_for
from embomatrix.world.dataset import Dataset, DatasetError
from embomatrix.world.task import MAX_TABLE

if TYPE_CHECKING:
    from embomatrix.cli.evaluation_settings import EvalSettings, Exam

MAX_TOKENS: Final = "max_tokens"
"""Name of the setting that limits an answer."""


@dataclass(frozen=True, slots=True)
class EvaluatedModel:
    """Model, endpoint or baseline that is ready to answer, with its codec, maximum table rows and maximum tokens.

    ``counter`` measures prompts and plans for it, None for a baseline.
    """

    ask: Callable[[Sequence[Question], AnswerSheet, OnProgress], None]
    codec: Codec = Codec.JSON
    rows: int = MAX_TABLE
    max_tokens: int = 1
    counter: TokenCounter | None = None


def evaluated_policy(exam: Exam, model: str, settings: EvalSettings) -> EvaluatedModel:
    """Load the model. Raises TrainerError."""
    from embomatrix.trainer.evaluation.models import load_model
    from embomatrix.trainer.policy.playing import plays_episodes

    policy, trained = load_model(model, settings.codec, threads=settings.threads, device=settings.device)
    if isinstance(exam, NativeExam) and policy.codec is Codec.NAMES:
        raise TrainerError(
            f"{model} is a word-level policy, which can't read {NATIVE}'s prompts: pass another model"
        )
    counter = TokenCounter.of_policy(policy)
    prompts = {each.task_id: each.prompt for each in exam.questions(policy.codec, trained.prompt.rows)}
    in_episodes = plays_episodes(policy)
    room = trained.episodes.answer_tokens if in_episodes else room_for(trained.grpo.max_new, prompts, counter)
    max_tokens = settings.max_tokens or room
    if not in_episodes:
        check_context(prompts, max_tokens, counter, MAX_TOKENS)
    rows = trained.prompt.rows
    if in_episodes:
        if not isinstance(exam, EpisodeExam):
            raise TrainerError(f"{model} was trained in episodes and writes no plans: pass --interactive")
        from embomatrix.trainer.evaluation.policy_agent import converse_in_episodes

        return EvaluatedModel(
            functools.partial(converse_in_episodes, policy, exam.stage),
            policy.codec,
            rows,
            max_tokens,
            counter,
        )
    if isinstance(exam, EpisodeExam):
        from embomatrix.trainer.evaluation.replanning import ask_policy_in_episodes

        playing = functools.partial(ask_policy_in_episodes, policy, rows, exam.stage)
        return EvaluatedModel(playing, Codec.LINES, rows, max_tokens, counter)
    return EvaluatedModel(functools.partial(ask_policy, policy), policy.codec, rows, max_tokens, counter)


def evaluated_endpoint(
    exam: Exam, url: str, model_name: str, key: str, settings: EvalSettings, folder: Path
) -> EvaluatedModel:
    if not model_name:
        raise TrainerError("the endpoint's model has no name: pass --model-name as the endpoint calls it")
    if settings.codec is Codec.NAMES:
        raise TrainerError("the codec `names` is for word-level policies: pass --codec json or lines")
    from embomatrix.llm.endpoint import Endpoint, EndpointLimits

    limits = EndpointLimits(attempts=settings.attempts, concurrent=settings.concurrent)
    connect = functools.partial(Endpoint, url, model_name, api_key=key, limits=limits)
    if isinstance(exam, EpisodeExam):
        ask = functools.partial(ask_endpoint_in_episodes, connect, folder, exam.stage)
    else:
        ask = functools.partial(ask_endpoint, connect, folder / "ledger.jsonl")
    codec, max_tokens = settings.codec or Codec.JSON, settings.max_tokens or ANSWER_TOKENS
    return EvaluatedModel(ask, codec, max_tokens=max_tokens, counter=TokenCounter.of_endpoint(codec))


def playing_baseline(exam: EpisodeExam, baseline: BaselineName, seed: int) -> EvaluatedModel:
    """Baseline that plays episodes. Raises TrainerError for one that doesn't."""
    if baseline in SCRIPTS:
        raise TrainerError(
            f"the baseline `{baseline}` writes whole plans: leave out --interactive, or pass the baseline oracle or greedy"
        )
    if baseline is BaselineName.HUMAN:
        raise TrainerError(f"the human plans are of {NATIVE}: pass --baseline oracle")
    tasks = exam.bench.tasks
    if baseline is BaselineName.ORACLE:
        training = read_tasks(Dataset(exam.bench.training.folder, exam.bench.training.train))
        priors = PlacePriors(task.situation for task in training.values())

        def agent_of(task_id: str, sample: int) -> EpisodeAgent:
            return SearchingAgent(tasks[task_id], priors)
    else:
        plan = PLANNERS[baseline]

        def agent_of(task_id: str, sample: int) -> EpisodeAgent:
            rng = np.random.default_rng(seed_of(seed, task_id, sample))
            return PlanAgent(plan(tasks[task_id], rng))

    return EvaluatedModel(functools.partial(play_episodes, exam.stage, agent_of), Codec.LINES)


def written_baseline(
    exam: WorldExam | NativeExam, name: BaselineName, training: Path | None
) -> Callable[[str, np.random.Generator], str]:
    """Function that writes a baseline's answer: its plan in our world, the published human plan in EAI's."""
    if isinstance(exam, NativeExam):
        if name is not BaselineName.HUMAN:
            raise TrainerError(
                f"the baseline `{name}` is for our own tasks: on {NATIVE} pass --baseline human"
            )
        return lambda task_id, rng: exam.human(task_id)
    if name is BaselineName.HUMAN:
        raise TrainerError(f"the human plans are of {NATIVE}: pass --bench {NATIVE}, or --baseline oracle")
    bench, tasks = exam.bench, exam.bench.tasks
    if name in SCRIPTS:
        scripts = fitted_scripts(name, bench.training if training is None else _training_tasks(training))
        return lambda task_id, rng: json.dumps(plan_to_json(scripts.plan(task_id, tasks[task_id].situation)))
    plan = PLANNERS[name]
    return lambda task_id, rng: json.dumps(plan_to_json(plan(tasks[task_id], rng)))


def _training_tasks(folder: Path) -> Dataset:
    try:
        return open_dataset(folder)
    except (DatasetError, OSError) as error:
        raise TrainerError(str(error)) from error
