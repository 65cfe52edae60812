"""`bench cluster`, part flow: cost of the manager with thousands of rollouts in flight.

The manager and its store are real, embedded and once more with Redis. This process is the trainer. The worker executes
nothing, so only the manager limits the flow, and a rollout costs it as much as with real slots.
"""

from __future__ import annotations

import asyncio
import itertools
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

from embomatrix.bench.cluster.cpu import CpuWatch, cpu_s
from embomatrix.bench.cluster.load_generator import LoadGenerator, load_generator
from embomatrix.bench.cluster.processes import (
    BenchCluster,
    RedisServer,
    bench_cluster,
    redis_program,
    redis_server,
    running_process,
)
from embomatrix.bench.report.figures import quantile
from embomatrix.pages.figures import Better, Figure
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.rollout import rollout_from_proto, rollout_to_proto
from embomatrix.rpc.wire.values import Rollout

if TYPE_CHECKING:
    from embomatrix.bench.engine.workload import Workload

MANAGER_GOAL_US: Final = 150.0
DISPATCH_GOAL_MS: Final = 10.0
POLL_S: Final = 0.05
NULL_WORKER: Final = "embomatrix.bench.cluster.null_worker"
REDIS_OPTIONS: Final = ("--appendonly", "yes", "--maxmemory-policy", "noeviction", "--save", "")
"""Options of docker-compose.yml."""


@dataclass(frozen=True, slots=True)
class FlowSizes:
    """Batches of ``in_flight`` rollouts, the next submitted before the last is done.

    The manager's memory is measured with ``most`` rollouts in flight too. The flow through Redis is measured without it (0).
    """

    slots: int = 2
    in_flight: int = 4_096
    batches: int = 4
    most: int = 16_000
    limit_s: float = 120.0


@dataclass(frozen=True, slots=True)
class Flow:
    """Measurements of one flow. ``waits_s`` are from a message with results to the next message with leases."""

    rollouts: int
    wall_s: float
    manager_s: float
    """CPU time of the manager."""
    store_s: float
    """CPU time of the store's server; 0 for the embedded store."""
    waits_s: tuple[float, ...]
    rss_mb: dict[int, float]
    """Resident memory of the manager by rollouts in flight."""


def bench_flow(workload: Workload, sizes: FlowSizes, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Measure with the embedded store, then with Redis if a redis-server is installed.

    Raise BenchError if a process ends or the time is up; ClusterError for a refused call.
    """
    with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name:
        flow = _measured(Path(name), workload, sizes, on_step)
    (few, few_mb), (most, most_mb) = sorted(flow.rss_mb.items())
    each_kb = (most_mb - few_mb) / (most - few) * 1e3
    figures = (
        *_speed(flow, "", MANAGER_GOAL_US, DISPATCH_GOAL_MS),
        Figure("manager_rss_mb_16k", most_mb, "MB", Better.LOWER, most),
        Figure(f"manager's memory, {few} rollouts in flight", few_mb, "MB", Better.LOWER, few),
        Figure("manager's memory for each more in flight", each_kb, "kB", Better.LOWER, most - few),
    )
    if redis_program() is None:
        return figures
    with (
        tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name,
        redis_server(Path(name), *REDIS_OPTIONS) as redis,
    ):
        on_step("the same with Redis")
        flow = _measured(Path(name), workload, replace(sizes, most=0), on_step, redis)
    server_us = flow.store_s / flow.rollouts * 1e6
    server = Figure("CPU of redis-server for a rollout", server_us, "µs", Better.LOWER, flow.rollouts)
    return (*figures, server, *_speed(flow, ", with Redis"))


def _measured(
    folder: Path,
    workload: Workload,
    sizes: FlowSizes,
    on_step: Callable[[str], None],
    redis: RedisServer | None = None,
) -> Flow:
    deadline_s = time.monotonic() + sizes.limit_s
    state = redis.url if redis else ""
    store = None if redis is None else psutil.Process(redis.process.child.pid)
    with bench_cluster(folder, workers=0, slots=sizes.slots, deadline_s=deadline_s, state=state) as cluster:

        async def measure() -> Flow:
            limit_s = deadline_s - time.monotonic()
            async with load_generator(cluster, workload.bundles, limit_s) as load:
                flow = await _flow(folder, cluster, load, workload, sizes, on_step, store)
                if not sizes.most:
                    return flow
                return replace(flow, rss_mb=await _memory(cluster, load, workload, sizes.most, on_step))

        return asyncio.run(measure())


async def _flow(
    folder: Path,
    cluster: BenchCluster,
    load: LoadGenerator,
    workload: Workload,
    sizes: FlowSizes,
    on_step: Callable[[str], None],
    store: psutil.Process | None,
) -> Flow:
    """Push batches through the manager, two at a time, so that about one of them is in flight at any moment."""
    with running_process(folder, "null-worker", NULL_WORKER, cluster.address, str(sizes.slots)) as worker:
        on_step("warming up")
        await load.warm_up(workload.rollouts)
        await load.submit(_repeated(workload, sizes.in_flight // 4))
        on_step(f"{sizes.in_flight} rollouts in flight")
        batch, turns = _repeated(workload, sizes.in_flight), asyncio.Semaphore(2)

        async def submit() -> int:
            async with turns:
                return len((await load.submit(batch)).arrivals)

        began_s, watch, store_s = time.monotonic(), CpuWatch(cluster), cpu_s(store) if store else 0.0
        count = sum(await asyncio.gather(*(submit() for _ in range(sizes.batches))))
        wall_s, used = time.monotonic() - began_s, watch.used()
        store_s = cpu_s(store) - store_s if store else 0.0
        lines = [line.split() for line in worker.log.read_text(encoding="utf-8").splitlines()]
        waits_s = tuple(float(wait_s) for at_s, wait_s in lines if began_s < float(at_s) < began_s + wall_s)
    return Flow(count, wall_s, used.manager_s, store_s, waits_s, {})


async def _memory(
    cluster: BenchCluster, load: LoadGenerator, workload: Workload, most: int, on_step: Callable[[str], None]
) -> dict[int, float]:
    """Resident memory of the manager with a quarter of the rollouts in flight, and with all of them; no worker answers."""
    manager = psutil.Process(cluster.processes[0].child.pid)
    rss_mb: dict[int, float] = {}
    parts = (most // 4, most - most // 4)
    async with ClusterClient(cluster.address) as viewer:
        submissions = []
        for count, total in zip(parts, itertools.accumulate(parts), strict=True):
            on_step(f"{total} rollouts in flight without a worker")
            submissions.append(asyncio.create_task(load.submit(_repeated(workload, count))))
            while True:
                if sum(run.pending for run in await viewer.list_runs()) >= total:
                    break
                await asyncio.sleep(POLL_S)
            rss_mb[total] = manager.memory_info().rss / 1e6
        for submission in submissions:
            submission.cancel()
        await asyncio.gather(*submissions, return_exceptions=True)
    return rss_mb


def _repeated(workload: Workload, count: int) -> tuple[Rollout, ...]:
    """Cycle through the workload's rollouts under new ids. They are serialised here, outside the measured flow."""
    plans: Sequence[Rollout] = workload.sample(len(workload.rollouts))
    named = (
        replace(rollout, rollout_id=f"{number}", group_id=f"{number}")
        for number, rollout in enumerate(itertools.islice(itertools.cycle(plans), count))
    )
    return tuple(rollout_from_proto(rollout_to_proto(rollout)) for rollout in named)


def _speed(
    flow: Flow, store: str, cost_goal_us: float | None = None, wait_goal_ms: float | None = None
) -> tuple[Figure, ...]:
    """Cost of a rollout for the manager, wait of slots for leases, and throughput."""
    count, waits = flow.rollouts, flow.waits_s
    cost_us, wait_ms = flow.manager_s / count * 1e6, quantile(waits, 0.99) * 1e3
    through = f"rollouts that the manager lets through{store}"
    return (
        Figure(f"manager_cpu_us{store}", cost_us, "µs", Better.LOWER, count, cost_goal_us),
        Figure(f"dispatch_p99_ms{store}", wait_ms, "ms", Better.LOWER, len(waits), wait_goal_ms),
        Figure(through, count / flow.wall_s, "1/s", Better.HIGHER, count),
    )
