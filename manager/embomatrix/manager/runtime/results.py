"""Result logs of batches, and the delivery of results from outcome to log."""

from __future__ import annotations

import asyncio
import bisect
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from embomatrix.manager.control.commands import AcknowledgeLease, DeliverResult, FinishBatch
from embomatrix.manager.control.dispatch.batches import GroupEnds
from embomatrix.manager.runtime.serialization import result_row, timed_row
from embomatrix.manager.store.protocol import BatchResults, FencedError, ResultRow, StateError, StateStore
from embomatrix.rpc.wire.values import Completed, RolloutResult

logger = logging.getLogger(__name__)

PER_MESSAGE: Final = 256
"""Results of one message at most."""
MESSAGE_S: Final = 0.1
"""Interval between partial messages. Without it, a trainer gets a message for every message of every worker."""


class BatchLog:
    """Results of one batch, ordered by cursor.

    Cursors rise from 1 without gaps, unless the store lost its last second: lost results return under later cursors.
    """

    def __init__(
        self,
        run_id: str,
        batch_id: str,
        digest: str,
        rows: Sequence[ResultRow] = (),
        groups: Mapping[str, int] | None = None,
    ) -> None:
        """``groups`` gives the number of rollouts in each group."""
        self.run_id = run_id
        self.batch_id = batch_id
        self.digest = digest
        self.rows = list(rows)
        self.ends = GroupEnds(groups or {})
        """Receives each result before it is appended."""
        self.finished_s: float | None = None
        """Time at which every rollout had its outcome; None before."""
        self.dropped = False
        """The run was closed, or the log was discarded: no more results follow."""
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
        """Yield all results after the cursor until the batch ends, at most one partial message per ``MESSAGE_S``."""
        while rows := await self.after(cursor):
            cursor = rows[-1].cursor
            yield rows
            if len(rows) < PER_MESSAGE and not self.ended:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(MESSAGE_S):
                        await self._over.wait()

    async def after(self, cursor: int) -> list[ResultRow]:
        """Wait for results after the cursor, and return up to ``PER_MESSAGE`` of them; none if the batch has ended before.

        The wait ends with the batch, whose rollouts have deadlines, or with the caller's deadline.
        """
        while self.last_cursor <= cursor and not self.ended:
            await self._changed.wait()
        start = bisect.bisect_right(self.rows, cursor, key=lambda row: row.cursor)
        return self.rows[start : start + PER_MESSAGE]

    @property
    def last_cursor(self) -> int:
        """Cursor of the newest result; 0 before the first."""
        return self.rows[-1].cursor if self.rows else 0

    def _wake(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()


class ResultLogs:
    """All logs. Finished logs are discarded after ``ttl_s``, or earlier if more than ``limit`` results are kept."""

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
        """Return the finished logs to discard, oldest first."""
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


STORE_RETRY_S: Final = 0.5
"""Seconds between two attempts to write while the store is away."""


class ResultDelivery:
    """Delivery of results. They are stored before a trainer sees them, so a restarted manager never reuses a cursor.

    A worker's result is acknowledged only after it is stored: until then the worker keeps it. ``on_logged`` receives
    the run of logged results and the delivery time in seconds of each completed one.
    """

    def __init__(
        self,
        store: StateStore,
        logs: ResultLogs,
        acknowledge: Callable[[AcknowledgeLease], None],
        on_logged: Callable[[str, Sequence[float]], None],
    ) -> None:
        self._store = store
        self._logs = logs
        self._acknowledge = acknowledge
        self._on_logged = on_logged
        self._waiting: list[tuple[DeliverResult | FinishBatch, float]] = []
        """Queued commands with their arrival times on the monotonic clock."""
        self._acknowledgements: list[AcknowledgeLease] = []
        self._fresh = asyncio.Event()
        self.problem = ""
        """Reason why results wait for the store; empty while they do not."""

    def put(self, command: DeliverResult | FinishBatch) -> None:
        """Queue a result, or the end of a batch. The queue is bounded by the number of rollouts in the cluster."""
        self._waiting.append((command, time.monotonic()))

    def put_acknowledgement(self, command: AcknowledgeLease) -> None:
        """Queue an acknowledgement, which is sent after everything queued before it is stored."""
        self._acknowledgements.append(command)

    def flush(self) -> None:
        """Start to write the queue: no related results follow."""
        if self._waiting or self._acknowledgements:
            self._fresh.set()

    async def serve(self) -> None:
        """Write until cancelled. Raises FencedError after another manager took over."""
        while True:
            await self._fresh.wait()
            self._fresh.clear()
            waiting, self._waiting = self._waiting, []
            acknowledgements, self._acknowledgements = self._acknowledgements, []
            pages: dict[tuple[str, str], _Page] = {}
            for command, arrived_s in waiting:
                key = (command.run_id, command.batch_id)
                log = self._logs.get(*key)
                if log is not None:
                    page = pages.get(key) or pages.setdefault(key, _Page(log))
                    page.add(command, arrived_s)
            await self._write(tuple(pages.values()))
            for page in pages.values():
                self._show(page)
            for acknowledgement in acknowledgements:
                self._acknowledge(acknowledgement)

    async def give_up_outdated(self, now_s: float) -> None:
        """Discard logs that are too old or too many."""
        for log in self._logs.outdated(now_s):
            self._logs.remove(log)
            with contextlib.suppress(StateError):
                await self._store.drop_batch(log.run_id, log.batch_id)

    async def _write(self, pages: Sequence[_Page]) -> None:
        """Write the new results of all batches in one transaction, since a commit of one row costs about as much as
        one of hundreds.
        """
        while parts := [page.part for page in pages if page.rows and not page.log.dropped]:
            try:
                await self._store.append_results(parts)
                break
            except FencedError:
                raise
            except StateError as error:
                self.problem = str(error)
                logger.warning("results wait for the store: %s", error)
                await asyncio.sleep(STORE_RETRY_S)
        self.problem = ""

    def _show(self, page: _Page) -> None:
        now_s = time.monotonic()
        for result, _ in page.results:
            page.log.ends.take(result.cursor, result.group_id, type(result.outcome), result.count)
        page.log.append(
            [
                timed_row(row, now_s - arrived_s) if isinstance(result.outcome, Completed) else row
                for row, (result, arrived_s) in zip(page.rows, page.results, strict=True)
            ]
        )
        completed = (at_s for result, at_s in page.results if isinstance(result.outcome, Completed))
        self._on_logged(page.log.run_id, [now_s - arrived_s for arrived_s in completed])
        if page.last:
            page.log.finish(now_s)


@dataclass(slots=True)
class _Page:
    """New results of one batch with their arrival times; ``last`` if the batch ends with them."""

    log: BatchLog
    results: list[tuple[RolloutResult, float]] = field(default_factory=list)
    rows: list[ResultRow] = field(default_factory=list)
    last: bool = False

    def add(self, command: DeliverResult | FinishBatch, arrived_s: float) -> None:
        match command:
            case DeliverResult(_, _, result):
                self.results.append((result, arrived_s))
                self.rows.append(result_row(result))
            case FinishBatch():
                self.last = True

    @property
    def part(self) -> BatchResults:
        return BatchResults(self.log.run_id, self.log.batch_id, self.rows)
