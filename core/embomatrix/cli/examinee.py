"""Who answers `embomatrix eval`: a model, an endpoint or a baseline, and what the setup says of it.

torch is imported only where a policy runs in this process.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.skills.parse import plan_to_json
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.eai.exam import NAME as NATIVE
from embomatrix.trainer.eai.exam import NativeExam
from embomatrix.trainer.evaluation.answer_sources import EndpointSource, PolicySource, ScriptSource
from embomatrix.trainer.evaluation.baselines import BaselineName, baseline_for
from embomatrix.trainer.evaluation.exam import WorldExam
from embomatrix.world.task import MAX_TABLE

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import numpy as np

    from embomatrix.trainer.evaluation.answer_sources import AnswerSource
    from embomatrix.trainer.evaluation.exam import Exam
    from embomatrix.world.task import Profile

ENDPOINT_TOKENS: Final = 1024
"""A plan of 64 steps in JSON, and some reasoning before it."""


@dataclass(frozen=True, slots=True)
class Questions:
    """How tasks are asked. ``max_tokens``, ``codec``: None where the asked one's own is wanted."""

    samples: int
    temperature: float
    seed: int
    max_tokens: int | None
    codec: Codec | None
    profile: Profile


@dataclass(frozen=True, slots=True)
class Chosen:
    """Who is to be asked, as a person says it; one of the first three is given."""

    model: str
    endpoint: str
    baseline: BaselineName | None
    model_name: str
    key: str
    concurrent: int
    attempts: int
    threads: int | None
    device: str


@dataclass(frozen=True, slots=True)
class EvaluationSubject:
    """Who is asked, and what its setup says of it."""

    asker: AnswerSource
    label: str
    codec: Codec
    rows: int
    max_tokens: int


def asked_of(exam: Exam, chosen: Chosen, questions: Questions, folder: Path) -> EvaluationSubject:
    """Whoever is chosen, ready to answer an exam; ``folder`` takes an endpoint's ledger. Raises TrainerError."""
    if chosen.model:
        from embomatrix.trainer.evaluation.models import load_model

        loaded = load_model(chosen.model, questions.codec, threads=chosen.threads, device=chosen.device)
        if isinstance(exam, NativeExam) and loaded.policy.codec is Codec.NAMES:
            raise TrainerError(
                f"{chosen.model} is a word-level policy and can't read the prompts of {NATIVE}"
            )
        tokens = questions.max_tokens or loaded.max_tokens
        return EvaluationSubject(
            PolicySource(loaded.policy), chosen.model, loaded.policy.codec, loaded.rows, tokens
        )
    if chosen.endpoint:
        return _endpoint(chosen, questions, folder)
    name = chosen.baseline or BaselineName.ORACLE
    return EvaluationSubject(ScriptSource(_writer(exam, name)), name.value, Codec.JSON, MAX_TABLE, 1)


def _writer(exam: Exam, name: BaselineName) -> Callable[[str, np.random.Generator], str]:
    """How a baseline answers: in our world by its plans, in EAI's by the published human ones."""
    if isinstance(exam, NativeExam):
        if name is not BaselineName.HUMAN:
            raise TrainerError(
                f"the baseline `{name}` writes plans of our world: on {NATIVE} pass --baseline human"
            )
        return lambda task_id, rng: exam.human(task_id)
    if name is BaselineName.HUMAN or not isinstance(exam, WorldExam):
        raise TrainerError(f"the human plans are of {NATIVE}: pass --bench {NATIVE}, or --baseline oracle")
    plan, tasks = baseline_for(name), exam.bench.tasks
    return lambda task_id, rng: json.dumps(plan_to_json(plan(tasks[task_id], rng)))


def _endpoint(chosen: Chosen, questions: Questions, folder: Path) -> EvaluationSubject:
    if not chosen.model_name:
        raise TrainerError("the endpoint's model has no name: pass --model-name as the endpoint calls it")
    if questions.codec is Codec.NAMES:
        raise TrainerError("the codec `names` is for word-level policies: pass --codec json or lines")
    from embomatrix.llm.endpoint import Endpoint, EndpointLimits

    limits = EndpointLimits(attempts=chosen.attempts, concurrent=chosen.concurrent)
    opened = functools.partial(
        Endpoint, chosen.endpoint, chosen.model_name, api_key=chosen.key, limits=limits
    )
    tokens = questions.max_tokens or ENDPOINT_TOKENS
    asker = EndpointSource(opened, folder / "ledger.jsonl")
    return EvaluationSubject(asker, chosen.model_name, questions.codec or Codec.JSON, MAX_TABLE, tokens)
