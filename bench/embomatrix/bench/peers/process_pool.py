"""`concurrent.futures.ProcessPoolExecutor` in the contest.

Processes are spawned: its documentation warns of forking a process that has threads, as one with gRPC has. Tuned, a process
loads its scenes when it starts and takes chunks, which its documentation advises for many short calls. It has no retry:
when a process dies, the executor is broken and all that it had is lost.
"""

from __future__ import annotations

import contextlib
import multiprocessing
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING, Any

from embomatrix.bench.peers.contender import LibraryMode, Lost, follow
from embomatrix.bench.peers.engine_pool import execute_fresh, execute_held

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.bench.peers.contender import ContenderSetup, RolloutChunk, Take


@contextlib.contextmanager
def process_pool(setup: ContenderSetup) -> Iterator[PoolContender]:
    """Executors for as long as the context lasts, one for each queue."""
    context = multiprocessing.get_context("spawn")
    with contextlib.ExitStack() as stack:
        yield PoolContender(
            setup,
            [
                stack.enter_context(ProcessPoolExecutor(setup.processes_each, mp_context=context))
                for _ in range(setup.lanes)
            ],
        )


class PoolContender:
    """Submits chunks to executors."""

    def __init__(self, setup: ContenderSetup, executors: Sequence[ProcessPoolExecutor]) -> None:
        self._setup = setup
        self._executors = executors

    def run(self, chunks: Sequence[RolloutChunk], take: Take, limit_s: float) -> None:
        futures = {}
        for chunk in chunks:
            try:
                futures[self._submit(chunk)] = chunk
            except BrokenProcessPool as error:
                take(Lost(len(chunk.rollouts), type(error).__name__))
        follow(futures, take, limit_s)

    def victim(self, pids: Sequence[int]) -> int:
        return pids[-1]

    def _submit(self, chunk: RolloutChunk) -> Future[Any]:
        executor, folder = self._executors[chunk.lane], str(self._setup.folder)
        if self._setup.mode is LibraryMode.PLAIN:
            return executor.submit(execute_fresh, folder, *chunk.requests)
        return executor.submit(execute_held, folder, self._setup.preload, chunk.requests)
