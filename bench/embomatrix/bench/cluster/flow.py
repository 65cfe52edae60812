"""`bench cluster`, part flow: what the manager costs while thousands of rollouts are in flight.

A real manager with its embedded store, and once more with Redis, this process as the trainer, and in another a worker that
executes nothing: so nothing but the manager limits the flow, and a rollout costs it what it costs with real slots.
"""

from __future__ import annotations

import asyncio
import itertools
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

from embomatrix.bench.cluster.cpu import CpuWatch, cpu_s
from embomatrix.bench.cluster.load_generator import trainer_on
from embomatrix.bench.cluster.null_worker import Order, hollow_worker
from embomatrix.bench.cluster.processes import bench_cluster
from embomatrix.bench.cluster.redis import redis_program, redis_server
from embomatrix.bench.report.figures import quantile
from embomatrix.pages.figures import Better, Figure
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.rollout import rollout_from_proto, rollout_to_proto

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from embomatrix.bench.cluster.load_generator import BenchTrainer, Pushed
    from embomatrix.bench.cluster.processes import BenchCluster
    from embomatrix.bench.cluster.redis import RedisServer
    from embomatrix.bench.cluster.work import ClusterWorkload
    from embomatrix.rpc.wire.values import Rollout

MANAGER_GOAL_US: Final = 150.0
DISPATCH_GOAL_MS: Final = 10.0
POLL_S: Final = 0.05
MB: Final = 1e6
REDIS_OPTIONS: Final = ("--appendonly", "yes", "--maxmemory-policy", "noeviction", "--save", "")
"""As in docker-compose.yml."""


@dataclass(frozen=True, slots=True)
class FlowSizes:
    """Batches of ``in_flight`` rollouts, the next submitted before the last is done.

    With ``most`` of them at once the manager's memory is learnt; 0: not at all.
    """

    slots: int = 2
    in_flight: int = 4_096
    batches: int = 4
    most: int = 16_000
    limit_s: float = 120.0


@dataclass(frozen=True, slots=True)
class Flow:
    """``waits_s``: from a message with results to the next leases. ``rss_mb`` by the rollouts in flight."""

    rollouts: int
    wall_s: float
    manager_s: float
    """Processor time."""
    waits_s: tuple[float, ...]
    rss_mb: dict[int, float]
    store_s: float
    """Processor time of the store's server; 0 for the embedded one."""


def bench_flow(work: ClusterWorkload, sizes: FlowSizes, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """With the embedded store, and then with Redis where there is a redis-server.

    Raises BenchError when the manager dies or the time is up; ClusterError for a call refused.
    """
    with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name:
        figures = _figures(_measured(Path(name), work, sizes, on_step))
    if redis_program() is None:
        return figures
    with (
        tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name,
        redis_server(Path(name), *REDIS_OPTIONS) as redis,
    ):
        on_step("the same with Redis")
        return (
            *figures,
            *_redis_figures(_measured(Path(name), work, replace(sizes, most=0), on_step, redis)),
        )


def _measured(
    folder: Path,
    work: ClusterWorkload,
    sizes: FlowSizes,
    on_step: Callable[[str], None],
    redis: RedisServer | None = None,
) -> Flow:
    deadline_s = time.monotonic() + sizes.limit_s
    state = redis.url if redis else ""
    store = None if redis is None else psutil.Process(redis.process.child.pid)
    with bench_cluster(folder, workers=0, slots=sizes.slots, deadline_s=deadline_s, state=state) as cluster:
        return asyncio.run(_measure(cluster, work, sizes, on_step, deadline_s, store))


async def _measure(
    cluster: BenchCluster,
    work: ClusterWorkload,
    sizes: FlowSizes,
    on_step: Callable[[str], None],
    deadline_s: float,
    store: psutil.Process | None,
) -> Flow:
    plan = work.rollouts[0].plan
    async with (
        trainer_on(cluster, work.bundles, deadline_s - time.monotonic()) as trainer,
        hollow_worker(cluster.address, plan, sizes.slots) as worker,
    ):
        on_step("executing nothing, to learn how fast")
        await trainer.warm_up(work.rollouts)
        await trainer.push(_repeated(work, sizes.in_flight // 4))
        on_step(f"{sizes.in_flight} rollouts in flight")
        batches = [_repeated(work, sizes.in_flight)] * sizes.batches
        await worker.tell(Order.BEGIN)
        watch, started_s, store_s = CpuWatch(cluster), time.perf_counter(), cpu_s(store) if store else 0.0
        count = await _flow(trainer, batches)
        wall_s, used = time.perf_counter() - started_s, watch.used()
        store_s = cpu_s(store) - store_s if store else 0.0
        waits_s = await worker.tell(Order.KEEP)
        rss_mb = await _memory(cluster, trainer, work, sizes, on_step) if sizes.most else {}
    return Flow(count, wall_s, used.manager_s, waits_s, rss_mb, store_s)


async def _flow(trainer: BenchTrainer, batches: Sequence[Sequence[Rollout]]) -> int:
    """Two batches at a time, so that about one of them is in flight at any moment; tells how many rollouts came back."""
    turns = asyncio.Semaphore(2)

    async def push(rollouts: Sequence[Rollout]) -> int:
        async with turns:
            pushed = await trainer.push(rollouts)
            return len([arrival.completed for arrival in pushed.arrivals])

    return sum(await asyncio.gather(*map(push, batches)))


async def _memory(
    cluster: BenchCluster,
    trainer: BenchTrainer,
    work: ClusterWorkload,
    sizes: FlowSizes,
    on_step: Callable[[str], None],
) -> dict[int, float]:
    """The manager's memory with a quarter of the rollouts in flight, and with all: nobody answers."""
    manager = psutil.Process(cluster.processes[0].child.pid)
    rss_mb: dict[int, float] = {}
    pushes: list[asyncio.Task[Pushed]] = []
    parts = (sizes.most // 4, sizes.most - sizes.most // 4)
    async with ClusterClient(cluster.address) as viewer:
        for count, total in zip(parts, itertools.accumulate(parts), strict=True):
            on_step(f"{total} rollouts in flight that nobody executes")
            pushes.append(asyncio.create_task(trainer.push(_repeated(work, count))))
            await _pending(viewer, total)
            rss_mb[total] = manager.memory_info().rss / MB
    for push in pushes:
        push.cancel()
    await asyncio.gather(*pushes, return_exceptions=True)
    return rss_mb


async def _pending(viewer: ClusterClient, count: int) -> None:
    """Wait until so many rollouts have no outcome."""
    while True:
        if sum(run.pending for run in await viewer.list_runs()) >= count:
            return
        await asyncio.sleep(POLL_S)


def _repeated(work: ClusterWorkload, count: int) -> tuple[Rollout, ...]:
    """So many of the workload's rollouts, over and over, each with an id of its own.

    They are written as messages here, so that it takes no time of the flow.
    """
    plans = itertools.islice(itertools.cycle(work.sample(len(work.rollouts))), count)
    named = (replace(rollout, rollout_id=f"{n}", group_id=f"{n}") for n, rollout in enumerate(plans))
    return tuple(rollout_from_proto(rollout_to_proto(rollout)) for rollout in named)


def _figures(flow: Flow) -> tuple[Figure, ...]:
    (few, few_mb), (most, most_mb) = sorted(flow.rss_mb.items())
    each_kb = (most_mb - few_mb) / (most - few) * 1e3
    return (
        *_speed(flow, "", MANAGER_GOAL_US, DISPATCH_GOAL_MS),
        Figure("manager_rss_mb_16k", most_mb, "MB", Better.LOWER, most),
        Figure(f"manager's memory, {few} rollouts in flight", few_mb, "MB", Better.LOWER, few),
        Figure("manager's memory for each more in flight", each_kb, "kB", Better.LOWER, most - few),
    )


def _redis_figures(flow: Flow) -> tuple[Figure, ...]:
    cpu_us = flow.store_s / flow.rollouts * 1e6
    server = Figure("CPU of redis-server for a rollout", cpu_us, "µs", Better.LOWER, flow.rollouts)
    cost, *others = _speed(flow, ", with Redis")
    return (cost, server, *others)


def _speed(
    flow: Flow, store: str, cost_goal_us: float | None = None, wait_goal_ms: float | None = None
) -> tuple[Figure, ...]:
    """What a rollout costs the manager, how long slots wait for leases, and how many rollouts go through."""
    count, waits = flow.rollouts, flow.waits_s
    cost_us, wait_ms = flow.manager_s / count * 1e6, quantile(waits, 0.99) * 1e3
    through = f"rollouts that the manager lets through{store}"
    return (
        Figure(f"manager_cpu_us{store}", cost_us, "µs", Better.LOWER, count, goal=cost_goal_us),
        Figure(f"dispatch_p99_ms{store}", wait_ms, "ms", Better.LOWER, len(waits), goal=wait_goal_ms),
        Figure(through, count / flow.wall_s, "1/s", Better.HIGHER, count),
    )
