"""State in this process: nothing survives it. For tests, and for clusters whose trainers can start over."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from embomatrix.manager.store.protocol import (
    BatchResults,
    BatchRow,
    Candidate,
    FencedError,
    Lead,
    PutOutcome,
    ResultRow,
    RunRow,
    Shelf,
    ShelfRow,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence


class MemoryState:
    """What several ``MemoryStore`` objects share, as managers share a database."""

    def __init__(self) -> None:
        self.epoch = 0
        self.leader: Candidate | None = None
        self.leads_until_s = 0.0
        self.workers: frozenset[str] = frozenset()
        self.runs: dict[str, RunRow] = {}
        self.batches: dict[tuple[str, str], BatchRow] = {}
        self.results: dict[tuple[str, str], dict[str, ResultRow]] = {}
        self.shelves: dict[Shelf, dict[str, ShelfRow]] = {shelf: {} for shelf in Shelf}


class MemoryStore:
    def __init__(self, state: MemoryState | None = None) -> None:
        self._state = state or MemoryState()
        self._epoch = 0
        self._candidate: Candidate | None = None

    async def claim(self, candidate: Candidate) -> Lead:
        state = self._state
        leader = state.leader
        if leader and leader.holder != candidate.holder and time.monotonic() < state.leads_until_s:
            return Lead(state.epoch, leader.address, mine=False)
        state.epoch += 1
        self._epoch = state.epoch
        self._candidate = candidate
        await self.renew()
        return Lead(self._epoch, candidate.address, mine=True)

    async def renew(self) -> None:
        self._check()
        self._state.leader = self._candidate
        self._state.leads_until_s = time.monotonic() + (self._candidate.ttl_s if self._candidate else 0.0)

    async def open_run(self, run: RunRow) -> None:
        self._check()
        self._state.runs.setdefault(run.run_id, run)

    async def close_run(self, run_id: str) -> None:
        self._check()
        self._state.runs.pop(run_id, None)
        self._state.shelves[Shelf.WINDOWS].pop(run_id, None)
        for key in [key for key in self._state.batches if key[0] == run_id]:
            await self.drop_batch(*key)

    async def put_batch(self, batch: BatchRow) -> PutOutcome:
        self._check()
        if batch.run_id not in self._state.runs:
            return PutOutcome.NO_RUN
        key = (batch.run_id, batch.batch_id)
        if key not in self._state.batches:
            self._state.batches[key] = batch
            return PutOutcome.CREATED
        return PutOutcome.SAME if self._state.batches[key].digest == batch.digest else PutOutcome.CONFLICT

    async def append_results(self, parts: Sequence[BatchResults]) -> int:
        self._check()
        return sum(self._append((part.run_id, part.batch_id), part.rows) for part in parts)

    def _append(self, key: tuple[str, str], rows: Sequence[ResultRow]) -> int:
        if key not in self._state.batches:
            return 0
        results = self._state.results.setdefault(key, {})
        before = len(results)
        for row in rows:
            results.setdefault(row.rollout_id, row)
        return len(results) - before

    async def results_after(self, run_id: str, batch_id: str, cursor: int, limit: int) -> list[ResultRow]:
        results = self._state.results.get((run_id, batch_id), {}).values()
        return sorted((row for row in results if row.cursor > cursor), key=lambda row: row.cursor)[:limit]

    async def drop_batch(self, run_id: str, batch_id: str) -> None:
        self._check()
        self._state.batches.pop((run_id, batch_id), None)
        self._state.results.pop((run_id, batch_id), None)

    async def runs(self) -> list[RunRow]:
        return list(self._state.runs.values())

    async def batches(self, run_id: str) -> list[BatchRow]:
        return [batch for key, batch in self._state.batches.items() if key[0] == run_id]

    async def put_workers(self, worker_ids: Collection[str]) -> None:
        self._check()
        self._state.workers = frozenset(worker_ids)

    async def workers(self) -> frozenset[str]:
        return self._state.workers

    async def put_rows(self, shelf: Shelf, rows: Sequence[ShelfRow]) -> None:
        self._check()
        self._state.shelves[shelf].update((row.key, row) for row in rows)

    async def rows(self, shelf: Shelf) -> list[ShelfRow]:
        return list(self._state.shelves[shelf].values())

    async def close(self) -> None:
        if self._epoch == self._state.epoch:
            self._state.leader = None

    def _check(self) -> None:
        if self._epoch != self._state.epoch:
            raise FencedError("another manager took over the in-memory state: stop this one")
