"""Process that parses answers of models, with limits of memory and time.

Answers come from outside, and parsing them holds the interpreter. The event loop of the manager must not wait for it.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import resource
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Final

from embomatrix.manager.web.reward_request import RewardRequest
from embomatrix.rpc.reward_label import RewardLabel, answer_in
from embomatrix.rpc.status import UnavailableError
from embomatrix.skills.parse import PlanError, parse_plan
from embomatrix.skills.syntax import Plan

PARSE_S: Final = 20.0
MEMORY_MB: Final = 1_024
Answer = tuple[RewardLabel, Plan | None]
"""Label of an answer, and its plan; None for a text that is no plan."""


class AnswerParser:
    """Parses one request at a time in a process of its own, which starts with the first request."""

    def __init__(self, *, parse_s: float = PARSE_S) -> None:
        self._parse_s = parse_s
        self._pool: ProcessPoolExecutor | None = None
        self._turn = asyncio.Lock()
        """Held while a request is parsed: the time of a request must not include the wait for others, nor end theirs."""

    async def parse(self, body: bytes) -> list[Answer]:
        """Return the answers of a request in order. Raises InvalidRequestError for a malformed request, and
        UnavailableError if its texts take too much time or memory.
        """
        async with self._turn:
            return await self._parse(body)

    async def _parse(self, body: bytes) -> list[Answer]:
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(1, context, initializer=_limit_memory, initargs=(MEMORY_MB,))
        try:
            async with asyncio.timeout(self._parse_s):
                loop = asyncio.get_running_loop()
                return await loop.run_in_executor(self._pool, parse_answers, body)
        except (TimeoutError, BrokenProcessPool, MemoryError) as error:
            self.close()
            raise UnavailableError(
                f"the answers could not be parsed within {self._parse_s:g} s and {MEMORY_MB} MB: "
                "send fewer at once, and leave out texts that are no plans"
            ) from error

    def close(self) -> None:
        """End the process at once."""
        pool, self._pool = self._pool, None
        if pool is not None:
            for process in list((pool._processes or {}).values()):
                process.kill()
            pool.shutdown(wait=False, cancel_futures=True)


def _limit_memory(more_mb: int) -> None:
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limit = mapped + more_mb * 1024 * 1024
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def parse_answers(body: bytes) -> list[Answer]:
    """Parse the body of a request. Raises InvalidRequestError."""
    request = RewardRequest.read(body)
    answers: list[Answer] = []
    for query, prompt, text in zip(request.query, request.prompts, request.labels, strict=True):
        label = RewardLabel.parse(text)
        try:
            answers.append((label, parse_plan(answer_in(query, prompt), label.profile)))
        except PlanError:
            answers.append((label, None))
    return answers
