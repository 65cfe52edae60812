"""Result logs: what was delivered, by batch, for trainers to read from any cursor for as long as it is kept."""

from __future__ import annotations

import asyncio
import bisect
import contextlib
import time
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.dispatch.batches import GroupEnds

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator, Mapping, Sequence

    from embomatrix.manager.store.protocol import ResultRow

PER_MESSAGE: Final = 256
LINGER_S: Final = 0.1
"""Results are sent at once when a message is full or the batch at its end, else one message in this time: a batch that
trickles shall not send one by one."""


class BatchLog:
    """The results of one batch in the order of their cursors.

    These rise from 1, without gaps unless the store lost its last second: what was lost comes again under later ones.
    """

    def __init__(
        self,
        run_id: str,
        batch_id: str,
        digest: str,
        rows: Sequence[ResultRow] = (),
        groups: Mapping[str, int] | None = None,
    ) -> None:
        """``groups`` tells how many rollouts each has."""
        self.run_id = run_id
        self.batch_id = batch_id
        self.digest = digest
        self.rows = list(rows)
        self.ends = GroupEnds(groups or {})
        """Told of each result before it is appended."""
        self.finished_s: float | None = None
        """When every rollout had its outcome; None before."""
        self.dropped = False
        """The run was closed, or the log was given up: nothing more will come."""
        self._changed = asyncio.Event()
        self._over = asyncio.Event()

    def append(self, rows: Sequence[ResultRow]) -> None:
        self.rows.extend(rows)
        self._wake()

    def finish(self, now_s: float) -> None:
        self.finished_s = now_s
        self._over.set()
        self._wake()

    def drop(self) -> None:
        self.dropped = True
        self._over.set()
        self._wake()

    @property
    def ended(self) -> bool:
        return self.dropped or self.finished_s is not None

    async def messages(self, cursor: int) -> AsyncIterator[list[ResultRow]]:
        """All results beyond the cursor, to the end of the batch: the first at once, then as ``LINGER_S`` allows."""
        due_s = 0.0
        while rows := await self.after(cursor, due_s):
            cursor = rows[-1].cursor
            due_s = time.monotonic() + LINGER_S
            yield rows

    async def after(self, cursor: int, due_s: float | None = None) -> list[ResultRow]:
        """Waits for results beyond the cursor; returns some of them, or nothing when the batch is at its end.

        Others are waited for until ``due_s`` on the monotonic clock, by default as long as results linger. The wait ends
        with the batch, whose rollouts have deadlines, or with the caller's own.
        """
        while self.last_cursor <= cursor and not self.ended:
            await self._changed.wait()
        left_s = LINGER_S if due_s is None else due_s - time.monotonic()
        if left_s > 0 and self.last_cursor - cursor < PER_MESSAGE and not self.ended:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left_s):
                    await self._over.wait()
        start = self._position(cursor)
        return self.rows[start : start + PER_MESSAGE]

    @property
    def last_cursor(self) -> int:
        """Of the newest result; 0 before the first."""
        return self.rows[-1].cursor if self.rows else 0

    def _position(self, cursor: int) -> int:
        return bisect.bisect_right(self.rows, cursor, key=lambda row: row.cursor)

    def _wake(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()


class ResultLogs:
    """All logs, bounded: finished ones go after ``ttl_s``, or earlier when more than ``limit`` results are kept."""

    def __init__(self, *, ttl_s: float, limit: int) -> None:
        self._ttl_s = ttl_s
        self._limit = limit
        self._logs: dict[tuple[str, str], BatchLog] = {}

    def __iter__(self) -> Iterator[BatchLog]:
        return iter(self._logs.values())

    def get(self, run_id: str, batch_id: str) -> BatchLog | None:
        return self._logs.get((run_id, batch_id))

    def add(self, log: BatchLog) -> None:
        self._logs[log.run_id, log.batch_id] = log

    def remove(self, log: BatchLog) -> None:
        self._logs.pop((log.run_id, log.batch_id), None)
        log.drop()

    def close_run(self, run_id: str) -> None:
        for log in [log for log in self if log.run_id == run_id]:
            self.remove(log)

    def outdated(self, now_s: float) -> list[BatchLog]:
        """Finished logs that are to be given up, oldest first."""
        finished = sorted(
            (log for log in self if log.finished_s is not None), key=lambda log: log.finished_s or 0.0
        )
        kept = sum(len(log.rows) for log in self)
        out: list[BatchLog] = []
        for log in finished:
            if kept <= self._limit and now_s - (log.finished_s or 0.0) < self._ttl_s:
                break
            kept -= len(log.rows)
            out.append(log)
        return out
