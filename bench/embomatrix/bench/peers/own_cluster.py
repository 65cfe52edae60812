"""Our own cluster in the contest: a manager and a worker, driven over gRPC as a trainer drives them."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.cpu import running_slot
from embomatrix.bench.cluster.load_generator import BenchTrainer, connected
from embomatrix.bench.cluster.processes import bench_cluster
from embomatrix.bench.peers.contender import Done, Lost
from embomatrix.bench.report.figures import BenchError
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import Completed

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.bench.cluster.load_generator import Arrival
    from embomatrix.bench.cluster.processes import BenchCluster
    from embomatrix.bench.cluster.work import ClusterWorkload
    from embomatrix.bench.peers.contender import ContenderSetup, RolloutChunk, Take

LIMIT_S: Final = 120.0
"""For the whole life of the cluster."""


@contextlib.contextmanager
def own_cluster(setup: ContenderSetup, work: ClusterWorkload) -> Iterator[OwnContender]:
    """A cluster for as long as the context lasts, with the scenes of the work announced and warm."""
    deadline_s = time.monotonic() + LIMIT_S
    with (
        bench_cluster(setup.folder, workers=1, slots=setup.slots, deadline_s=deadline_s) as cluster,
        asyncio.Runner() as runner,
    ):
        stack = contextlib.AsyncExitStack()
        try:
            yield OwnContender(cluster, runner, runner.run(_join(stack, cluster, work)))
        finally:
            runner.run(stack.aclose())


async def _join(
    stack: contextlib.AsyncExitStack, cluster: BenchCluster, work: ClusterWorkload
) -> BenchTrainer:
    """A trainer whose client lasts as long as the stack, with every scene warm."""
    client = await stack.enter_async_context(ClusterClient(cluster.address))
    try:
        async with asyncio.timeout(LIMIT_S):
            await connected(client, cluster)
            await client.put_bundles(work.bundles)
            trainer = BenchTrainer(client, await client.open_run("bench"))
            await trainer.warm_up(work.rollouts)
    except TimeoutError:
        cluster.check()
        raise BenchError(
            f"the cluster was not warm within {LIMIT_S:g} s: is the machine overloaded?"
        ) from None
    return trainer


class OwnContender:
    """Submits all chunks as one batch: sharing it out is the dispatcher's business."""

    def __init__(self, cluster: BenchCluster, runner: asyncio.Runner, trainer: BenchTrainer) -> None:
        self._cluster = cluster
        self._runner = runner
        self._trainer = trainer

    def run(self, chunks: Sequence[RolloutChunk], take: Take, limit_s: float) -> None:
        rollouts = [rollout for chunk in chunks for rollout in chunk.rollouts]

        async def submit() -> None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(limit_s):
                    async for arrival in self._trainer.stream(rollouts):
                        take(_news(arrival))

        self._runner.run(submit())

    def victim(self, pids: Sequence[int]) -> int:
        return running_slot(self._cluster)


def _news(arrival: Arrival) -> Done | Lost:
    outcome = arrival.result.outcome
    if isinstance(outcome, Completed):
        return Done(0, int(not outcome.warm), (outcome,), max(0, arrival.result.attempt - 1))
    return Lost(1, type(outcome).__name__)
