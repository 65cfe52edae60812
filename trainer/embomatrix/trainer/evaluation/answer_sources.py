"""Sources of answers: a policy in this process, a model behind an endpoint, or a script.

Each fills an answer sheet; stored answers are not requested again.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

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
"""Gets the number of stored answers and the total."""

PURPOSE: Final = "eval"
CHUNK: Final = 8
"""Tasks that a policy samples together."""
MAX_SEED: Final = 2**31


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


def ask_policy(
    policy: Policy, questions: Sequence[Question], sheet: AnswerSheet, on_progress: OnProgress
) -> None:
    """Ask a policy in this process. Each chunk of tasks has its own seed, so a resumed evaluation draws the same plans."""
    import torch

    setup = sheet.setup
    device = next(iter(policy.parameters())).device
    for at in range(0, len(questions), CHUNK):
        chunk = questions[at : at + CHUNK]
        keys = [(question.task_id, sample) for question in chunk for sample in range(setup.samples)]
        if any(key not in sheet for key in keys):
            seed = seed_of(setup.seed, chunk[0].task_id, 0)
            drawn = policy.sample(
                [policy.encode(question.prompt) for question in chunk],
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


def ask_endpoint(
    open_endpoint: Callable[[], Endpoint],
    ledger_file: Path,
    questions: Sequence[Question],
    sheet: AnswerSheet,
    on_progress: OnProgress,
) -> None:
    """Ask a model behind an OpenAI-compatible endpoint. Token usage goes to ``ledger_file``, one line per call.

    A failed question raises TrainerError with the number of stored answers. Earlier answers stay on the sheet.
    """
    total = len(questions) * sheet.setup.samples

    async def ask_all() -> None:
        async with open_endpoint() as endpoint:
            model = Ledger(endpoint, path=ledger_file)

            async def ask_one(question: Question, sample: int) -> None:
                reply = await model.complete(_request(question, sheet.setup, sample))
                used = (reply.usage.prompt_tokens, reply.usage.completion_tokens)
                sheet.add([Answer(question.task_id, sample, reply.text, reply.finish, *used)])
                on_progress(len(sheet), total)

            async with asyncio.TaskGroup() as group:
                for question in questions:
                    for sample in range(sheet.setup.samples):
                        if (question.task_id, sample) not in sheet:
                            group.create_task(ask_one(question, sample))

    try:
        asyncio.run(ask_all())
    except ExceptionGroup as errors:
        first = errors.exceptions[0]
        if not isinstance(first, LlmError):
            raise first from errors
        message = str(first).removeprefix(f"{PURPOSE}: ")  # the command prints its own name
        raise TrainerError(
            f"{message}; {len(sheet)} of {total} answers are kept in {sheet.path}: the same command continues from there"
        ) from errors


def ask_script(
    write: Callable[[str, np.random.Generator], str],
    questions: Sequence[Question],
    sheet: AnswerSheet,
    on_progress: OnProgress,
) -> None:
    """Ask a baseline, or take a benchmark's human plans. ``write`` returns the text for a task's id.

    Equal generators must give equal texts.
    """
    for question in questions:
        for sample in range(sheet.setup.samples):
            rng = np.random.default_rng(seed_of(sheet.setup.seed, question.task_id, sample))
            sheet.add([Answer(question.task_id, sample, write(question.task_id, rng))])
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
