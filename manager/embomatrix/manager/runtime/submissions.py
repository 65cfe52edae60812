"""Large batches enter the state machines in pieces, so that no worker waits for the whole of one."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.events import BatchContinued, BatchSubmitted

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.manager.control.events import Event
    from embomatrix.rpc.wire.values import Batch

PIECE: Final = 256
"""Rollouts that are queued at once: some three milliseconds, in which nothing else is decided."""


class Submissions:
    """``feed`` tells the state machines of an event. Batches that enter at the same time take turns, piece by piece."""

    def __init__(self, feed: Callable[[Event], None]) -> None:
        self._feed = feed
        self._entering: deque[tuple[str, str, int]] = deque()
        self._more = asyncio.Event()

    def enter(self, batch: Batch) -> None:
        """The first piece at once, the others as ``serve`` comes to them."""
        self._feed(BatchSubmitted(batch, PIECE))
        left = len(batch.rollouts) - PIECE
        if left > 0:
            self._entering.append((batch.run_id, batch.batch_id, left))
            self._more.set()

    async def serve(self) -> None:
        """Go on with what has begun to enter, until cancelled."""
        while True:
            await self._more.wait()
            self._more.clear()
            while self._entering:
                # Whatever came meanwhile is heard between two pieces.
                await asyncio.sleep(0)
                run_id, batch_id, left = self._entering.popleft()
                self._feed(BatchContinued(run_id, batch_id, PIECE))
                if left > PIECE:
                    self._entering.append((run_id, batch_id, left - PIECE))
