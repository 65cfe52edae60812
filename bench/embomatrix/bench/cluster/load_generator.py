"""Load generator: it announces scenes, submits rollouts and records the arrival of every result."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from collections import Counter
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.bench.report.figures import BenchError
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.values import (
    Batch,
    Completed,
    LookaheadEntry,
    Rollout,
    RolloutResult,
    RunStats,
    Warmth,
)

if TYPE_CHECKING:
    from embomatrix.bench.cluster.processes import BenchCluster

POLL_S: Final = 0.005
COMPLETE_S: Final = 0.5
"""Time for a warm scene to complete its deferred work."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """Result of one rollout. ``latency_s`` counts from the submission of its batch."""

    latency_s: float
    result: RolloutResult

    @property
    def completed(self) -> Completed:
        """The result. Raise BenchError if the rollout failed: on an undisturbed machine none does."""
        outcome = self.result.outcome
        if isinstance(outcome, Completed):
            return outcome
        raise BenchError(f"rollout {self.result.rollout_id} had no result: {outcome}")

    @property
    def start_s(self) -> float:
        """Seconds until the execution began, plus the result's way back."""
        return self.latency_s - self.completed.timings.execute_s


@dataclass(frozen=True, slots=True)
class Submission:
    """Rollouts that were submitted together. ``wall_s`` is the time until the last result."""

    wall_s: float
    arrivals: tuple[Arrival, ...]


class LoadGenerator:
    """Trainer with one open run. ``submit`` sends one batch at a time."""

    def __init__(self, client: ClusterClient, run_id: str) -> None:
        self._client = client
        self._run_id = run_id
        self._versions = itertools.count(1)
        self._batches = itertools.count(1)

    async def announce(self, steps: Mapping[int, Sequence[Rollout]]) -> Mapping[str, Warmth]:
        """Replace the look-ahead window and return how warm each scene is."""
        entries = [
            LookaheadEntry(step, digest, count)
            for step, rollouts in steps.items()
            for digest, count in Counter(rollout.bundle_digest for rollout in rollouts).items()
        ]
        return await self._client.announce_lookahead(self._run_id, next(self._versions), entries)

    async def warm_up(self, rollouts: Sequence[Rollout]) -> None:
        """Announce the scenes and wait until all are warm and complete. Raise BenchError if one fits nowhere."""
        while True:
            warmth = await self.announce({1: rollouts})
            if Warmth.UNPLACEABLE in warmth.values():
                raise BenchError("a scene fits on no worker: free some memory")
            if all(state is Warmth.WARM for state in warmth.values()):
                break
            await asyncio.sleep(POLL_S)
        await asyncio.sleep(COMPLETE_S)

    async def stream(self, rollouts: Sequence[Rollout]) -> AsyncIterator[Arrival]:
        """Submit one batch and yield each result as it arrives."""
        number = next(self._batches)
        batch = Batch(self._run_id, str(number), number, tuple(rollouts))
        started_s = time.perf_counter()
        async for result in self._client.execute(batch):
            yield Arrival(time.perf_counter() - started_s, result)

    async def submit(self, rollouts: Sequence[Rollout]) -> Submission:
        """Submit one batch and wait for all results. Raise BenchError if a rollout failed."""
        started_s = time.perf_counter()
        arrivals = [arrival async for arrival in self.stream(rollouts)]
        wall_s = time.perf_counter() - started_s
        for arrival in arrivals:
            _ = arrival.completed
        return Submission(wall_s, tuple(arrivals))

    async def submit_singly(self, rollouts: Sequence[Rollout]) -> Submission:
        """Submit each rollout when the one before it has its result."""
        single = [await self.submit((rollout,)) for rollout in rollouts]
        arrivals = tuple(arrival for each in single for arrival in each.arrivals)
        return Submission(sum(each.wall_s for each in single), arrivals)

    async def close(self) -> RunStats:
        """End the run and return its counters."""
        return await self._client.close_run(self._run_id)


@contextlib.asynccontextmanager
async def load_generator(
    cluster: BenchCluster, bundles: Mapping[str, bytes], limit_s: float, *, merging: bool = True
) -> AsyncIterator[LoadGenerator]:
    """Open a run once all workers have joined and the manager holds the bundles.

    Raise BenchError if a process ends, or if ``limit_s`` seconds pass before the context is left.
    """
    try:
        async with asyncio.timeout(limit_s), ClusterClient(cluster.address, merging=merging) as client:
            await _all_joined(client, cluster)
            await client.put_bundles(bundles)
            yield LoadGenerator(client, await client.open_run("bench"))
    except TimeoutError:
        cluster.check()
        raise BenchError(
            f"a part of the benchmark took longer than {limit_s:g} s and was ended: allow more with --limit-s"
        ) from None


async def _all_joined(client: ClusterClient, cluster: BenchCluster) -> None:
    while True:
        cluster.check()
        with contextlib.suppress(ClusterError):
            workers = await client.list_workers()
            if cluster.workers <= {worker.worker_id for worker in workers if worker.state == "ready"}:
                return
        await asyncio.sleep(10 * POLL_S)
