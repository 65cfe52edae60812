"""One event loop for code that is not asynchronous itself and asks language models now and then."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager


class OnOneLoop:
    """Context manager over one event loop, which closes the ``endpoint`` at its end: an HTTP client belongs to one loop."""

    def __init__(self, endpoint: AbstractAsyncContextManager[object] | None = None) -> None:
        self._endpoint = endpoint
        self._runner = asyncio.Runner()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._endpoint is not None:
            self._runner.run(self._closed(self._endpoint))
        self._runner.close()

    @staticmethod
    async def _closed(endpoint: AbstractAsyncContextManager[object]) -> None:
        await endpoint.__aexit__(None, None, None)
