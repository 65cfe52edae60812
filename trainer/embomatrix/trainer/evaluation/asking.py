"""Asks whoever is measured for plans: a policy in this process, a model behind an endpoint, or a baseline."""

from __future__ import annotations

import asyncio
import hashlib
import json
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from embomatrix.llm.ledger import Ledger
from embomatrix.llm.values import ChatRequest, LlmError, Message, Speaker
from embomatrix.skills.parse import plan_to_json
from embomatrix.skills.prompt import limited, prompt_for
from embomatrix.trainer.errors import TrainerError
from embomatrix.trainer.evaluation.answers import Answer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from embomatrix.llm.endpoint import Endpoint
    from embomatrix.skills.prompt import Codec, Prompt, Situation
    from embomatrix.trainer.data import TrainingTask
    from embomatrix.trainer.evaluation.answers import AnswerSheet, Setup
    from embomatrix.trainer.evaluation.baselines import Baseline
    from embomatrix.trainer.policy.protocol import Policy

    Report = Callable[[int, int], None]

PURPOSE: Final = "eval"
CHUNK: Final = 8
"""Tasks that a policy samples together."""
MAX_SEED: Final = 2**31


class Asker(Protocol):
    """Fills an answer sheet. What is there already is not asked for again."""

    def ask(self, tasks: Sequence[TrainingTask], sheet: AnswerSheet, report: Report) -> None: ...


def told(task: TrainingTask, rows: int) -> Situation:
    """What is told of a task: rows of its table at most, chosen by the instruction alone."""
    return limited(task.situation, rows)


def questions_digest(tasks: Iterable[TrainingTask], codec: Codec, rows: int) -> str:
    """SHA-256 of all prompts in their order."""
    content = hashlib.sha256()
    for task in tasks:
        prompt = prompt_for(told(task, rows), codec)
        content.update(f"{prompt.system}\0{prompt.user}\0".encode())
    return f"sha256:{content.hexdigest()}"


def seed_of(seed: int, task_id: str, sample: int) -> int:
    """Seed of one answer, in [0, 2^31)."""
    digest = hashlib.sha256(f"{seed}:{task_id}:{sample}".encode()).digest()
    return int.from_bytes(digest[:4], "big") % MAX_SEED


class PolicyAsker:
    """A policy in this process. Each chunk of tasks has a seed of its own: a resumed evaluation draws the same plans."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def ask(self, tasks: Sequence[TrainingTask], sheet: AnswerSheet, report: Report) -> None:
        import torch

        setup = sheet.setup
        device = next(iter(self._policy.parameters())).device
        for at in range(0, len(tasks), CHUNK):
            chunk = tasks[at : at + CHUNK]
            wanted = [(task.task.task_id, sample) for task in chunk for sample in range(setup.samples)]
            if any(key not in sheet for key in wanted):
                seed = seed_of(setup.seed, chunk[0].task.task_id, 0)
                drawn = self._policy.sample(
                    [
                        self._policy.encode(prompt_for(told(task, setup.rows), self._policy.codec))
                        for task in chunk
                    ],
                    setup.samples,
                    setup.temperature,
                    setup.max_tokens,
                    torch.Generator(device).manual_seed(seed),
                )
                tokens = drawn.mask.sum(dim=1).tolist()
                sheet.add(
                    Answer(task_id, sample, text, completion_tokens=int(count))
                    for (task_id, sample), text, count in zip(wanted, drawn.texts, tokens, strict=True)
                )
            report(len(sheet), len(tasks) * setup.samples)


class EndpointAsker:
    """A model behind an OpenAI-compatible endpoint; what it costs is written to ``ledger_file``, a line a call.

    A question that stays without an answer ends the asking with an error: what came before is on the sheet.
    """

    def __init__(self, open_endpoint: Callable[[], Endpoint], codec: Codec, ledger_file: Path) -> None:
        self._open_endpoint = open_endpoint
        self._codec = codec
        self._ledger_file = ledger_file

    def ask(self, tasks: Sequence[TrainingTask], sheet: AnswerSheet, report: Report) -> None:
        """Raises TrainerError that tells how many answers are kept."""
        total = len(tasks) * sheet.setup.samples
        try:
            asyncio.run(self._ask_all(tasks, sheet, lambda: report(len(sheet), total)))
        except ExceptionGroup as errors:
            first = errors.exceptions[0]
            if not isinstance(first, LlmError):
                raise first from errors
            raise TrainerError(
                f"{first}; {len(sheet)} of {total} answers are kept in {sheet.path}: the same command goes on from there"
            ) from errors

    async def _ask_all(
        self, tasks: Sequence[TrainingTask], sheet: AnswerSheet, report: Callable[[], None]
    ) -> None:
        async with self._open_endpoint() as endpoint:
            model = Ledger(endpoint, path=self._ledger_file)

            async def one(prompt: Prompt, task_id: str, sample: int) -> None:
                reply = await model.complete(_request(prompt, sheet.setup, task_id, sample))
                used = reply.usage
                sheet.add(
                    [
                        Answer(
                            task_id,
                            sample,
                            reply.text,
                            reply.finish,
                            used.prompt_tokens,
                            used.completion_tokens,
                        )
                    ]
                )
                report()

            async with asyncio.TaskGroup() as group:
                for task in tasks:
                    prompt = prompt_for(told(task, sheet.setup.rows), self._codec)
                    for sample in range(sheet.setup.samples):
                        if (task.task.task_id, sample) not in sheet:
                            group.create_task(one(prompt, task.task.task_id, sample))


class BaselineAsker:
    """A baseline that needs no model. It answers in JSON."""

    def __init__(self, baseline: Baseline) -> None:
        self._baseline = baseline

    def ask(self, tasks: Sequence[TrainingTask], sheet: AnswerSheet, report: Report) -> None:
        for task in tasks:
            for sample in range(sheet.setup.samples):
                rng = np.random.default_rng(seed_of(sheet.setup.seed, task.task.task_id, sample))
                plan = self._baseline(task, rng)
                sheet.add([Answer(task.task.task_id, sample, json.dumps(plan_to_json(plan)))])
            report(len(sheet), len(tasks) * sheet.setup.samples)


def _request(prompt: Prompt, setup: Setup, task_id: str, sample: int) -> ChatRequest:
    messages = [Message(Speaker.SYSTEM, prompt.system)] if prompt.system else []
    return ChatRequest(
        PURPOSE,
        (*messages, Message(Speaker.USER, prompt.user)),
        max_tokens=setup.max_tokens,
        temperature=setup.temperature,
        seed=seed_of(setup.seed, task_id, sample),
    )
