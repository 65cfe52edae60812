"""A trainer as the cluster's benches need one: it announces scenes, submits rollouts, and keeps when each result came."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.work import scenes_in
from embomatrix.bench.report.figures import BenchError
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.values import Batch, Completed, LookaheadEntry, Warmth

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping, Sequence

    from embomatrix.bench.cluster.processes import BenchCluster
    from embomatrix.rpc.wire.values import Rollout, RolloutResult, RunStats

POLL_S: Final = 0.005
COMPLETE_S: Final = 0.5
"""A scene that is announced waits for its first rollout, and makes meanwhile what that will need."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A result, and the seconds from the submission of its batch until it came."""

    latency_s: float
    result: RolloutResult

    @property
    def completed(self) -> Completed:
        """Raises BenchError when the rollout has no result: on an undisturbed machine none is lost."""
        outcome = self.result.outcome
        if isinstance(outcome, Completed):
            return outcome
        raise BenchError(f"rollout {self.result.rollout_id} had no result: {outcome}")

    def check(self) -> None:
        """Raises BenchError when the rollout has no result."""
        _ = self.completed

    @property
    def start_s(self) -> float:
        """Seconds until its execution began, with what the result's way back took."""
        return self.latency_s - self.completed.timings.execute_s


@dataclass(frozen=True, slots=True)
class Pushed:
    """What came of rollouts that were submitted together. ``wall_s`` is until the last result."""

    wall_s: float
    arrivals: tuple[Arrival, ...]


class BenchTrainer:
    """One open run. ``push`` submits one batch at a time."""

    def __init__(self, client: ClusterClient, run_id: str) -> None:
        self._client = client
        self._run_id = run_id
        self._versions = itertools.count(1)
        self._batches = itertools.count(1)

    async def announce(self, steps: Mapping[int, Sequence[Rollout]]) -> Mapping[str, Warmth]:
        """Replace the window of coming steps by these; tells how warm each scene is."""
        entries = [
            LookaheadEntry(step, digest, count)
            for step, rollouts in steps.items()
            for digest, count in scenes_in(rollouts).items()
        ]
        return await self._client.announce_lookahead(self._run_id, next(self._versions), entries)

    async def warm_up(self, rollouts: Sequence[Rollout]) -> None:
        """Announce the scenes and wait until all are warm and complete. Raises BenchError when one fits nowhere."""
        while True:
            warmth = await self.announce({1: rollouts})
            if Warmth.UNPLACEABLE in warmth.values():
                raise BenchError("a scene fits on no worker: free some memory")
            if all(state is Warmth.WARM for state in warmth.values()):
                break
            await asyncio.sleep(POLL_S)
        await asyncio.sleep(COMPLETE_S)

    async def stream(self, rollouts: Sequence[Rollout]) -> AsyncIterator[Arrival]:
        """Submit them at once; yields each result as it comes."""
        number = next(self._batches)
        batch = Batch(self._run_id, str(number), number, tuple(rollouts))
        started_s = time.perf_counter()
        async for result in self._client.execute(batch):
            yield Arrival(time.perf_counter() - started_s, result)

    async def push(self, rollouts: Sequence[Rollout]) -> Pushed:
        """Submit them at once and wait for all. Raises BenchError when one has no result."""
        started_s = time.perf_counter()
        arrivals = [arrival async for arrival in self.stream(rollouts)]
        wall_s = time.perf_counter() - started_s
        for arrival in arrivals:
            arrival.check()
        return Pushed(wall_s, tuple(arrivals))

    async def push_singly(self, rollouts: Sequence[Rollout]) -> Pushed:
        """Submit each when the one before it has its result."""
        single = [await self.push((rollout,)) for rollout in rollouts]
        return Pushed(
            sum(pushed.wall_s for pushed in single),
            tuple(arrival for pushed in single for arrival in pushed.arrivals),
        )

    async def close(self) -> RunStats:
        """End the run; tells its counters."""
        return await self._client.close_run(self._run_id)


@contextlib.asynccontextmanager
async def trainer_on(
    cluster: BenchCluster, bundles: Mapping[str, bytes], limit_s: float
) -> AsyncIterator[BenchTrainer]:
    """A trainer with a run of its own, once all workers have joined and the manager holds the bundles.

    Raises BenchError when a process dies, or when more than ``limit_s`` seconds pass until the trainer is done.
    """
    try:
        async with asyncio.timeout(limit_s), ClusterClient(cluster.address) as client:
            await connected(client, cluster)
            await client.put_bundles(bundles)
            yield BenchTrainer(client, await client.open_run("bench"))
    except TimeoutError:
        cluster.check()
        raise BenchError(
            f"a part of the bench took longer than {limit_s:g} s and was ended: allow more with --limit-s"
        ) from None


async def connected(client: ClusterClient, cluster: BenchCluster) -> None:
    """Wait until every worker has joined."""
    while True:
        cluster.check()
        with contextlib.suppress(ClusterError):
            workers = await client.list_workers()
            if cluster.workers <= {worker.worker_id for worker in workers if worker.state == "ready"}:
                return
        await asyncio.sleep(0.05)
