"""Ablation of the paper on one workload: cost of a rollout without the system, and with more and more of it.

Rows follow the paper's table on simulation latency: naive, with pre-cached execution, with the Resource-Scheduler, with the
Task-Dispatcher. Without a scheduler every rollout loads its scene. Without a dispatcher the next rollout is submitted when
the one before it has its result. Loading takes milliseconds here and most of a second in the paper, so the rows are measured
twice: as they are, and with a wait at every load.
"""

import asyncio
import contextlib
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from embomatrix.bench.cluster.cpu import CpuUse, CpuWatch
from embomatrix.bench.cluster.load_generator import LoadGenerator, Submission, load_generator
from embomatrix.bench.cluster.prewarm import SlowSteps, Submit
from embomatrix.bench.cluster.processes import bench_cluster
from embomatrix.bench.engine.engine import frozen_heap
from embomatrix.bench.engine.workload import Workload
from embomatrix.pages.figures import Better, Figure
from embomatrix.reward.hierarchy import score
from embomatrix.rpc.wire.values import Rollout
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Simulator
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.worker.slots.physics import CLIENTS_PER_SCENE
from embomatrix.world.bundle import Bundle, decode_bundle

FULL_GOAL_MS: Final = 2.0
RATIO_GOAL: Final = 500.0
RATE_GOAL_PER_SLOT: Final = 500.0
OVERHEAD_GOAL: Final = 0.1
OVERHEAD_GOAL_US: Final = 300.0
DELAY_S: Final = 0.7
"""Cost of loading in the paper: the cached row's 0.85 s less the scheduler's 0.14 s."""
PAUSE_OVER_DELAY: Final = 1.5
"""Generation time of a step over the loading delay."""


@dataclass(frozen=True, slots=True)
class AblationSizes:
    """Rollouts of each row. A naive one takes seconds."""

    naive: int = 16
    cached: int = 80
    singly: int = 80
    warm: int = 10
    """Plans of each scene that slots execute before the last row is measured."""
    rounds: int = 3
    """Clusters that are started for the last row. Each executes every plan once."""
    delay_s: float = DELAY_S
    slots: int = 2
    limit_s: float = 120.0
    """Limit for one cluster, from its first process to its last result."""


@dataclass(frozen=True, slots=True)
class ClusterRound:
    """Measurements of one cluster: most plans in one batch, the CPU time meanwhile, and some plans one by one."""

    at_once: Submission
    used: CpuUse
    singly: Submission


def bench_ablation(
    workload: Workload, sizes: AblationSizes, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """Measure all rows. Raise BenchError if a process ends or a rollout fails."""
    on_step("loading and executing in physical mode, rollout by rollout")
    naive_s = [_seconds(rollout, workload, physical_simulator) for rollout in workload.sample(sizes.naive)]
    on_step("loading and executing in cached mode, rollout by rollout")
    cached_s = _cached_s(workload, sizes.cached)
    rounds = []
    for number in range(sizes.rounds):
        on_step(f"executing on a cluster, round {number + 1} of {sizes.rounds}")
        rounds.append(_round(workload, sizes))
    on_step("executing with slowed loading")
    few = workload.first(max(1, sizes.singly // len(workload.scenes)))
    slow_singly = _slowed(few, sizes, LoadGenerator.submit_singly)
    slow_at_once = _slowed(workload, sizes, LoadGenerator.submit)
    at_once = [each.at_once for each in rounds]
    full_ms, count = _ms_each(at_once), _count(at_once)
    ratio = float(np.mean(naive_s)) * 1e3 / full_ms
    return (
        *_row("ablation_naive_ms", naive_s),
        *_row("ablation_cached_ms", cached_s),
        *_row("ablation_scheduler_ms", [arrival.latency_s for arrival in rounds[-1].singly.arrivals]),
        Figure("ablation_dispatcher_ms", full_ms, "ms", Better.LOWER, count, FULL_GOAL_MS),
        Figure("ablation_ratio", ratio, "×", Better.HIGHER, len(naive_s), RATIO_GOAL),
        Figure("ablation_ratio, equal cores", ratio / sizes.slots, "×", Better.HIGHER, len(naive_s)),
        _slow("ablation_naive_slow_ms", (float(np.mean(naive_s)) + sizes.delay_s) * 1e3, len(naive_s)),
        _slow("ablation_cached_slow_ms", (float(np.mean(cached_s)) + sizes.delay_s) * 1e3, len(cached_s)),
        _slow("ablation_scheduler_slow_ms", _ms_each(slow_singly), _count(slow_singly)),
        _slow("ablation_dispatcher_slow_ms", _ms_each(slow_at_once), _count(slow_at_once)),
        *_throughput(rounds, sizes),
    )


def _cached_s(workload: Workload, count: int) -> list[float]:
    """Seconds of each rollout in physics clients that stay connected."""
    with contextlib.closing(ClientPool(spare=CLIENTS_PER_SCENE)) as clients:

        def make(bundle: Bundle) -> Simulator:
            return Simulator(bundle, BulletEngine(bundle.scene, clients, PreparedScene.of(bundle)))

        return [_seconds(rollout, workload, make) for rollout in workload.sample(count)]


def _seconds(rollout: Rollout, workload: Workload, make: Callable[[Bundle], Simulator]) -> float:
    """Wall time from the bundle's bytes to the reward."""
    with frozen_heap():
        started_s = time.perf_counter()
        bundle = decode_bundle(workload.bundles[rollout.bundle_digest], digest=rollout.bundle_digest)
        with contextlib.closing(make(bundle)) as simulator:
            task = bundle.tasks[rollout.task_id]
            trace = simulator.execute(task, rollout.plan, rollout.seed)
            score(task, trace.touched, simulator.facts)
            return time.perf_counter() - started_s


def _round(workload: Workload, sizes: AblationSizes) -> ClusterRound:
    """Measure a fresh cluster with all scenes warm."""
    deadline_s = time.monotonic() + sizes.limit_s
    with (
        tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name,
        bench_cluster(Path(name), workers=1, slots=sizes.slots, deadline_s=deadline_s) as cluster,
    ):

        async def measure() -> ClusterRound:
            async with load_generator(cluster, workload.bundles, deadline_s - time.monotonic()) as load:
                await load.warm_up(workload.rollouts)
                await load.submit(workload.first(sizes.warm).rollouts)
                watch = CpuWatch(cluster)
                at_once = await load.submit(workload.after(sizes.warm).rollouts)
                used = watch.used()
                return ClusterRound(at_once, used, await load.submit_singly(workload.sample(sizes.singly)))

        return asyncio.run(measure())


def _slowed(workload: Workload, sizes: AblationSizes, submit: Submit) -> tuple[Submission, ...]:
    """Steps of a trainer that announces two steps ahead, on a worker that loads slowly."""
    pause_s = PAUSE_OVER_DELAY * sizes.delay_s
    steps = SlowSteps(workload.steps(sizes.slots), pause_s, sizes.delay_s, sizes.slots, sizes.limit_s)
    return steps.take(workload.bundles, submit)[0]


def _row(name: str, seconds: Sequence[float]) -> tuple[Figure, Figure]:
    count = len(seconds)
    mean_ms, spread_ms = float(np.mean(seconds)) * 1e3, float(np.std(seconds)) * 1e3
    return (
        Figure(name, mean_ms, "ms", Better.LOWER, count),
        Figure(f"{name}, standard deviation", spread_ms, "ms", Better.LOWER, count),
    )


def _slow(name: str, value_ms: float, count: int) -> Figure:
    return Figure(name, value_ms, "ms", Better.LOWER, count)


def _throughput(rounds: Sequence[ClusterRound], sizes: AblationSizes) -> tuple[Figure, ...]:
    at_once = [each.at_once for each in rounds]
    count, rate = _count(at_once), 1e3 / _ms_each(at_once)
    overhead = float(np.median([each.used.overhead for each in rounds]))
    parts = {
        "manager": sum(each.used.manager_s for each in rounds),
        "worker beside its slots": sum(each.used.daemons_s for each in rounds),
        "trainer": sum(each.used.trainer_s for each in rounds),
        "slots": sum(each.used.slots_s for each in rounds),
    }
    outside_us = sum(seconds for part, seconds in parts.items() if part != "slots") / count * 1e6
    return (
        Figure("rollouts_per_s", rate, "1/s", Better.HIGHER, count, RATE_GOAL_PER_SLOT * sizes.slots),
        Figure("overhead_ratio", overhead, "share", Better.LOWER, count, OVERHEAD_GOAL),
        Figure("overhead_cpu_us", outside_us, "µs", Better.LOWER, count, OVERHEAD_GOAL_US),
        *(
            Figure(f"CPU of a rollout: {part}", seconds / count * 1e6, "µs", Better.LOWER, count)
            for part, seconds in parts.items()
        ),
    )


def _ms_each(submissions: Sequence[Submission]) -> float:
    """Total wall time over the number of rollouts, in milliseconds."""
    return sum(item.wall_s for item in submissions) / _count(submissions) * 1e3


def _count(submissions: Sequence[Submission]) -> int:
    return sum(len(item.arrivals) for item in submissions)
