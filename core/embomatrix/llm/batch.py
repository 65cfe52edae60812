"""Support for synchronous code that asks a model many questions: one event loop, and a limit of unanswered questions."""

import asyncio
from contextlib import AbstractAsyncContextManager
from typing import Final, Self

from embomatrix.llm.values import LlmError

MOST_UNANSWERED: Final = 3
"""Consecutive questions without an answer, each retried, after which an endpoint counts as dead."""


class OnOneLoop:
    """Context manager over one event loop that closes ``endpoint`` at its end: an HTTP client belongs to one loop."""

    def __init__(self, endpoint: AbstractAsyncContextManager[object] | None = None) -> None:
        self._endpoint = endpoint
        self._runner = asyncio.Runner()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._endpoint is not None:
            self._runner.run(_close(self._endpoint))
        self._runner.close()


async def _close(endpoint: AbstractAsyncContextManager[object]) -> None:
    await endpoint.__aexit__(None, None, None)


class FailureLimit:
    """Counter of consecutive questions without a usable answer: a batch survives a few, but no dead endpoint."""

    def __init__(self, most: int = MOST_UNANSWERED) -> None:
        self._most = most
        self._unanswered = 0

    def answered(self) -> None:
        """Reset the counter."""
        self._unanswered = 0

    def unanswered(self, error: LlmError) -> None:
        """Count a question without a usable answer. Raises the error when the limit is reached."""
        self._unanswered += 1
        if self._unanswered >= self._most:
            raise error
