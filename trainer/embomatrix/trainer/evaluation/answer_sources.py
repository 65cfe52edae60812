"""Sources of answers: a policy in this process, a model behind an endpoint, or a script."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from embomatrix.llm.ledger import Ledger
from embomatrix.llm.values import ChatRequest, LlmError, Message, Speaker
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.evaluation.answers import Answer, AnswerSheet, EvaluationSetup

if TYPE_CHECKING:
    from embomatrix.llm.endpoint import Endpoint
    from embomatrix.trainer.evaluation.exam import Question
    from embomatrix.trainer.policy.protocol import Policy


OnProgress = Callable[[int, int], None]

PURPOSE: Final = "eval"
CHUNK: Final = 8
"""Tasks that a policy samples together."""
MAX_SEED: Final = 2**31


class AnswerSource(Protocol):
    """Fills an answer sheet. Stored answers are not requested again.

    ``on_progress`` gets the number of stored answers and the total.
    """

    def ask(self, questions: Sequence[Question], sheet: AnswerSheet, on_progress: OnProgress) -> None: ...


def questions_digest(questions: Iterable[Question]) -> str:
    """SHA-256 of all prompts in order."""
    content = hashlib.sha256()
    for question in questions:
        content.update(f"{question.prompt.system}\0{question.prompt.user}\0".encode())
    return f"sha256:{content.hexdigest()}"


def seed_of(seed: int, task_id: str, sample: int) -> int:
    """Seed of one answer, in [0, 2^31)."""
    digest = hashlib.sha256(f"{seed}:{task_id}:{sample}".encode()).digest()
    return int.from_bytes(digest[:4], "big") % MAX_SEED


class PolicySource:
    """Policy in this process. Each chunk of tasks has its own seed, so a resumed evaluation draws the same plans."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def ask(self, questions: Sequence[Question], sheet: AnswerSheet, on_progress: OnProgress) -> None:
        import torch

        setup = sheet.setup
        device = next(iter(self._policy.parameters())).device
        for at in range(0, len(questions), CHUNK):
            chunk = questions[at : at + CHUNK]
            keys = [(question.task_id, sample) for question in chunk for sample in range(setup.samples)]
            if any(key not in sheet for key in keys):
                seed = seed_of(setup.seed, chunk[0].task_id, 0)
                drawn = self._policy.sample(
                    [self._policy.encode(question.prompt) for question in chunk],
                    setup.samples,
                    setup.temperature,
                    setup.max_tokens,
                    torch.Generator(device).manual_seed(seed),
                )
                tokens = drawn.mask.sum(dim=1).tolist()
                sheet.add(
                    Answer(task_id, sample, text, completion_tokens=int(count))
                    for (task_id, sample), text, count in zip(keys, drawn.texts, tokens, strict=True)
                )
            on_progress(len(sheet), len(questions) * setup.samples)


class EndpointSource:
    """Model behind an OpenAI-compatible endpoint. Token usage goes to ``ledger_file``, one line per call.

    A failed question ends the evaluation with an error. Earlier answers stay on the sheet.
    """

    def __init__(self, open_endpoint: Callable[[], Endpoint], ledger_file: Path) -> None:
        self._open_endpoint = open_endpoint
        self._ledger_file = ledger_file

    def ask(self, questions: Sequence[Question], sheet: AnswerSheet, on_progress: OnProgress) -> None:
        """Raises TrainerError with the number of stored answers."""
        total = len(questions) * sheet.setup.samples
        try:
            asyncio.run(self._ask_all(questions, sheet, lambda: on_progress(len(sheet), total)))
        except ExceptionGroup as errors:
            first = errors.exceptions[0]
            if not isinstance(first, LlmError):
                raise first from errors
            message = str(first).removeprefix(f"{PURPOSE}: ")  # the command prints its own name
            raise TrainerError(
                f"{message}; {len(sheet)} of {total} answers are kept in {sheet.path}: the same command continues from there"
            ) from errors

    async def _ask_all(
        self, questions: Sequence[Question], sheet: AnswerSheet, on_answer: Callable[[], None]
    ) -> None:
        async with self._open_endpoint() as endpoint:
            model = Ledger(endpoint, path=self._ledger_file)

            async def ask_one(question: Question, sample: int) -> None:
                reply = await model.complete(_request(question, sheet.setup, sample))
                used = (reply.usage.prompt_tokens, reply.usage.completion_tokens)
                sheet.add([Answer(question.task_id, sample, reply.text, reply.finish, *used)])
                on_answer()

            async with asyncio.TaskGroup() as group:
                for question in questions:
                    for sample in range(sheet.setup.samples):
                        if (question.task_id, sample) not in sheet:
                            group.create_task(ask_one(question, sample))


class ScriptSource:
    """Source without prompts: a baseline, or a benchmark's human plans."""

    def __init__(self, write: Callable[[str, np.random.Generator], str]) -> None:
        """``write`` returns the text for a task's id. Equal generators give equal texts."""
        self._write = write

    def ask(self, questions: Sequence[Question], sheet: AnswerSheet, on_progress: OnProgress) -> None:
        for question in questions:
            for sample in range(sheet.setup.samples):
                rng = np.random.default_rng(seed_of(sheet.setup.seed, question.task_id, sample))
                sheet.add([Answer(question.task_id, sample, self._write(question.task_id, rng))])
            on_progress(len(sheet), len(questions) * sheet.setup.samples)


def _request(question: Question, setup: EvaluationSetup, sample: int) -> ChatRequest:
    prompt = question.prompt
    messages = [Message(Speaker.SYSTEM, prompt.system)] if prompt.system else []
    return ChatRequest(
        PURPOSE,
        (*messages, Message(Speaker.USER, prompt.user)),
        max_tokens=setup.max_tokens,
        temperature=setup.temperature,
        seed=seed_of(setup.seed, question.task_id, sample),
    )
