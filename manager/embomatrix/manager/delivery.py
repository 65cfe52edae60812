"""From outcome to trainer: results are written to the store, then shown in their batch's log, in the order of their cursors."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from typing import TYPE_CHECKING, Final

from embomatrix.manager.commands import DeliverResult, FinishBatch
from embomatrix.manager.records import result_row
from embomatrix.manager.store.protocol import FencedError, StateError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from embomatrix.manager.commands import AcknowledgeLease
    from embomatrix.manager.results import BatchLog, ResultLogs
    from embomatrix.manager.store.protocol import StateStore

logger = logging.getLogger(__name__)

STORE_RETRY_S: Final = 0.5
"""Between two attempts to write while the store is away."""


class Delivery:
    """Owns the way of results. What a trainer saw, a restarted manager knows, so no cursor is ever given twice.

    A worker hears that it may forget a result (``acknowledge``) only after the store has it: until then it is not lost
    with the manager.
    """

    def __init__(
        self, store: StateStore, logs: ResultLogs, acknowledge: Callable[[AcknowledgeLease], None]
    ) -> None:
        self._store = store
        self._logs = logs
        self._acknowledge = acknowledge
        self._waiting: list[DeliverResult | FinishBatch] = []
        self._acknowledgements: list[AcknowledgeLease] = []
        self._fresh = asyncio.Event()

    def put(self, command: DeliverResult | FinishBatch) -> None:
        """Queue a result, or the end of a batch. There are never more than there are rollouts in the cluster."""
        self._waiting.append(command)
        self._fresh.set()

    def put_acknowledgement(self, command: AcknowledgeLease) -> None:
        """Queue what a worker may forget; said once everything that was queued before is written."""
        self._acknowledgements.append(command)
        self._fresh.set()

    async def serve(self) -> None:
        """Write until cancelled; ends with ``FencedError`` when another manager took the store over."""
        while True:
            await self._fresh.wait()
            self._fresh.clear()
            commands, self._waiting = self._waiting, []
            acknowledgements, self._acknowledgements = self._acknowledgements, []
            by_batch: dict[tuple[str, str], list[DeliverResult | FinishBatch]] = {}
            for command in commands:
                by_batch.setdefault((command.run_id, command.batch_id), []).append(command)
            for key, ended in by_batch.items():
                log = self._logs.get(*key)
                if log is not None:
                    await self._publish(log, ended)
            for acknowledgement in acknowledgements:
                self._acknowledge(acknowledgement)

    async def give_up_outdated(self, now_s: float) -> None:
        """Drop logs that are too old, or too many."""
        for log in self._logs.outdated(now_s):
            self._logs.remove(log)
            with contextlib.suppress(StateError):
                await self._store.drop_batch(log.run_id, log.batch_id)

    async def _publish(self, log: BatchLog, ended: Sequence[DeliverResult | FinishBatch]) -> None:
        rows = [result_row(command.result) for command in ended if isinstance(command, DeliverResult)]
        while rows and not log.dropped:
            try:
                await self._store.append_results(log.run_id, log.batch_id, rows)
                break
            except FencedError:
                raise
            except StateError as error:
                logger.warning("results wait for the store: %s", error)
                await asyncio.sleep(STORE_RETRY_S)
        log.append(rows)
        if any(isinstance(command, FinishBatch) for command in ended):
            log.finish(time.monotonic())
