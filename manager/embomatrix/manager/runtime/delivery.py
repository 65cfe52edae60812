"""From outcome to trainer: results are written to the store, then shown in their batch's log, in the order of their cursors."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from embomatrix.manager.control.commands import DeliverResult, FinishBatch
from embomatrix.manager.runtime.records import result_row, timed_row
from embomatrix.manager.store.protocol import BatchResults, FencedError, StateError
from embomatrix.rpc.wire.values import Completed

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from embomatrix.manager.control.commands import AcknowledgeLease
    from embomatrix.manager.runtime.results import BatchLog, ResultLogs
    from embomatrix.manager.store.protocol import ResultRow, StateStore
    from embomatrix.rpc.wire.values import RolloutResult

logger = logging.getLogger(__name__)

STORE_RETRY_S: Final = 0.5
"""Between two attempts to write while the store is away."""


class ResultDelivery:
    """Owns the way of results. What a trainer saw, a restarted manager knows, so no cursor is ever given twice.

    A worker hears that it may forget a result (``acknowledge``) only after the store has it: until then it is not lost
    with the manager. ``on_logged`` is told of each run whose results are in their log, and how many seconds each of the
    completed took.
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
        self._waiting: list[_Waiting] = []
        self._acknowledgements: list[AcknowledgeLease] = []
        self._fresh = asyncio.Event()
        self.problem = ""
        """Why results wait for the store, while they do."""

    def put(self, command: DeliverResult | FinishBatch) -> None:
        """Queue a result, or the end of a batch. There are never more than there are rollouts in the cluster."""
        self._waiting.append(_Waiting(command, time.monotonic()))

    def put_acknowledgement(self, command: AcknowledgeLease) -> None:
        """Queue what a worker may forget; said once everything that was queued before is written."""
        self._acknowledgements.append(command)

    def hurry(self) -> None:
        """Nothing more comes with what is queued: have it written."""
        if self._waiting or self._acknowledgements:
            self._fresh.set()

    async def serve(self) -> None:
        """Write until cancelled; ends with ``FencedError`` when another manager took the store over."""
        while True:
            await self._fresh.wait()
            self._fresh.clear()
            waiting, self._waiting = self._waiting, []
            acknowledgements, self._acknowledgements = self._acknowledgements, []
            by_batch: dict[tuple[str, str], list[_Waiting]] = {}
            for entry in waiting:
                by_batch.setdefault((entry.command.run_id, entry.command.batch_id), []).append(entry)
            logs = {key: log for key in by_batch if (log := self._logs.get(*key)) is not None}
            pages = [_page(log, by_batch[key]) for key, log in logs.items()]
            await self._write(pages)
            for page in pages:
                self._show(page)
            for acknowledgement in acknowledgements:
                self._acknowledge(acknowledgement)

    async def give_up_outdated(self, now_s: float) -> None:
        """Drop logs that are too old, or too many."""
        for log in self._logs.outdated(now_s):
            self._logs.remove(log)
            with contextlib.suppress(StateError):
                await self._store.drop_batch(log.run_id, log.batch_id)

    async def _write(self, pages: Sequence[_Page]) -> None:
        """Write what is new of all batches at once: a commit costs about the same for one row as for hundreds."""
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
            page.log.ends.take(result.cursor, result.group_id, type(result.outcome))
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


class _Waiting(NamedTuple):
    """A command that waits to be written, and when it came, on the monotonic clock."""

    command: DeliverResult | FinishBatch
    arrived_s: float


@dataclass(frozen=True, slots=True)
class _Page:
    """What is new in one batch: results with the time at which each came, and whether they are the last."""

    log: BatchLog
    results: Sequence[tuple[RolloutResult, float]]
    rows: Sequence[ResultRow]
    last: bool

    @property
    def part(self) -> BatchResults:
        return BatchResults(self.log.run_id, self.log.batch_id, self.rows)


def _page(log: BatchLog, ended: Sequence[_Waiting]) -> _Page:
    delivered = [(entry.command, entry.arrived_s) for entry in ended]
    results = [
        (command.result, arrived_s) for command, arrived_s in delivered if isinstance(command, DeliverResult)
    ]
    last = any(isinstance(command, FinishBatch) for command, _ in delivered)
    return _Page(log, results, [result_row(result) for result, _ in results], last)
