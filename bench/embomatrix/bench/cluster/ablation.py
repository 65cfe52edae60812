"""The paper's ablation on one and the same work: what a rollout costs without the system, and with more and more of it.

The rows are those of the paper's table on simulation latency: naive, with pre-cached execution, with the
Resource-Scheduler, with the Task-Dispatcher. Without a scheduler every rollout loads its scene; without a dispatcher the next
rollout is submitted when the one before it has its result. Loading takes milliseconds here and most of a second in the paper,
so the rows are told twice: as they are, and with a wait at every load.
"""

from __future__ import annotations

import asyncio
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.bench.cluster.cpu import CpuWatch
from embomatrix.bench.cluster.load_generator import BenchTrainer, trainer_on
from embomatrix.bench.cluster.one_process import cached_s, naive
from embomatrix.bench.cluster.processes import bench_cluster
from embomatrix.bench.cluster.stepping import Stepping, take_steps
from embomatrix.bench.engine.user_world import user_s
from embomatrix.pages.figures import Better, Figure

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from embomatrix.bench.cluster.cpu import CpuUse
    from embomatrix.bench.cluster.load_generator import Pushed
    from embomatrix.bench.cluster.stepping import Push
    from embomatrix.bench.cluster.work import ClusterWorkload

FULL_GOAL_MS: Final = 2.0
RATIO_GOAL: Final = 500.0
RATE_GOAL_PER_SLOT: Final = 500.0
OVERHEAD_GOAL: Final = 0.1
DELAY_S: Final = 0.7
"""What loading costs in the paper: the cached row's 0.85 s less the 0.14 s of the scheduler's."""
PAUSE_OVER_DELAY: Final = 1.5
"""Where loading is slowed, a language model writes a step's plans for that many loads."""


@dataclass(frozen=True, slots=True)
class AblationSizes:
    """Rollouts of each row, all of the same work. A naive one takes seconds."""

    naive: int = 16
    user: int = 4
    """Of the naive ones, those that are also told as a user would write them."""
    cached: int = 80
    singly: int = 80
    warm: int = 10
    """Plans of each scene that slots execute before the last row is measured with the others: they have worked before."""
    rounds: int = 3
    """Clusters that are brought up for the last row: each executes every plan once, so that no rollout repeats another."""
    delay_s: float = DELAY_S
    slots: int = 2
    limit_s: float = 120.0
    """For one cluster, from its first process to its last result."""


@dataclass(frozen=True, slots=True)
class ClusterRows:
    """Of the rows that have a cluster: one by one, and all at once in every round."""

    singly: Pushed
    at_once: tuple[Pushed, ...]
    used: tuple[CpuUse, ...]
    """Processor time of each round while all went at once."""


def bench_ablation(
    work: ClusterWorkload, sizes: AblationSizes, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """All rows. Raises BenchError when a process dies or a rollout is lost, EngineError when a scene can't be loaded."""
    on_step("loading and executing physically, rollout by rollout")
    taken = naive(work.sample(sizes.naive), work.bundles)
    naive_s = [item.seconds for item in taken]
    on_step("loading and stepping as a user would write it")
    with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as folder:
        written_s = user_s(taken[: sizes.user], work.bundles, Path(folder))
    on_step("loading and executing in cached mode, rollout by rollout")
    loaded_s = cached_s(work.sample(sizes.cached), work.bundles)
    rows = _cluster_rows(work, sizes, on_step)
    on_step("executing with loading slowed")
    return (
        *_row("ablation_user_ms", written_s),
        *_row("ablation_naive_ms", naive_s),
        *_row("ablation_cached_ms", loaded_s),
        *_row("ablation_scheduler_ms", [arrival.latency_s for arrival in rows.singly.arrivals]),
        *_full_row(rows, naive_s, sizes),
        _slow("ablation_naive_slow_ms", float(np.mean(naive_s)) + sizes.delay_s, len(naive_s)),
        _slow("ablation_cached_slow_ms", float(np.mean(loaded_s)) + sizes.delay_s, len(loaded_s)),
        *_slowed_rows(work, sizes),
        *_throughput(rows, sizes),
    )


def _full_row(rows: ClusterRows, naive_s: Sequence[float], sizes: AblationSizes) -> tuple[Figure, ...]:
    """The row with everything, and how much less it is than the naive one."""
    full_ms, count = _ms_each(rows.at_once), _count(rows.at_once)
    ratio = float(np.mean(naive_s)) * 1e3 / full_ms
    return (
        Figure("ablation_dispatcher_ms", full_ms, "ms", Better.LOWER, count, FULL_GOAL_MS),
        Figure("ablation_ratio", ratio, "×", Better.HIGHER, len(naive_s), RATIO_GOAL),
        Figure("ablation_ratio, equal cores", ratio / sizes.slots, "×", Better.HIGHER, len(naive_s)),
    )


def _slowed_rows(work: ClusterWorkload, sizes: AblationSizes) -> tuple[Figure, ...]:
    few = work.first(max(1, sizes.singly // len(work.scenes)))
    singly = _slowed(few, sizes, BenchTrainer.push_singly)
    at_once = _slowed(work, sizes, BenchTrainer.push)
    return (
        _slow("ablation_scheduler_slow_ms", _ms_each(singly) / 1e3, _count(singly)),
        _slow("ablation_dispatcher_slow_ms", _ms_each(at_once) / 1e3, _count(at_once)),
    )


def _cluster_rows(work: ClusterWorkload, sizes: AblationSizes, on_step: Callable[[str], None]) -> ClusterRows:
    rounds = []
    for number in range(sizes.rounds):
        on_step(f"executing at once, round {number + 1} of {sizes.rounds}")
        rounds.append(_round(work, sizes))
    pushed, used, singly = zip(*rounds, strict=True)
    return ClusterRows(singly[-1], pushed, used)


def _round(work: ClusterWorkload, sizes: AblationSizes) -> tuple[Pushed, CpuUse, Pushed]:
    """In a fresh cluster with all scenes warm: most plans at once, then some one by one."""
    deadline_s = time.monotonic() + sizes.limit_s
    with (
        tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name,
        bench_cluster(Path(name), workers=1, slots=sizes.slots, deadline_s=deadline_s) as cluster,
    ):

        async def measure() -> tuple[Pushed, CpuUse, Pushed]:
            async with trainer_on(cluster, work.bundles, deadline_s - time.monotonic()) as trainer:
                await trainer.warm_up(work.rollouts)
                await trainer.push(work.first(sizes.warm).rollouts)
                watch = CpuWatch(cluster)
                pushed = await trainer.push(work.after(sizes.warm).rollouts)
                used = watch.used()
                return pushed, used, await trainer.push_singly(work.sample(sizes.singly))

        return asyncio.run(measure())


def _slowed(work: ClusterWorkload, sizes: AblationSizes, push: Push) -> tuple[Pushed, ...]:
    """Steps of a trainer that announces two steps ahead, on a worker that loads slowly."""
    stepping = Stepping(work.steps(sizes.slots), pause_s=PAUSE_OVER_DELAY * sizes.delay_s, push=push)
    return take_steps(work.bundles, stepping, sizes.slots, sizes.delay_s, sizes.limit_s).steps


def _row(name: str, seconds: Sequence[float]) -> tuple[Figure, Figure]:
    count = len(seconds)
    mean_ms, spread_ms = float(np.mean(seconds)) * 1e3, float(np.std(seconds)) * 1e3
    return (
        Figure(name, mean_ms, "ms", Better.LOWER, count),
        Figure(f"{name}, standard deviation", spread_ms, "ms", Better.LOWER, count),
    )


def _slow(name: str, seconds: float, count: int) -> Figure:
    return Figure(name, seconds * 1e3, "ms", Better.LOWER, count)


def _throughput(rows: ClusterRows, sizes: AblationSizes) -> tuple[Figure, ...]:
    count = _count(rows.at_once)
    goal = RATE_GOAL_PER_SLOT * sizes.slots
    overhead = float(np.median([use.overhead for use in rows.used]))
    parts = (
        ("manager", sum(use.manager_s for use in rows.used)),
        ("worker beside its slots", sum(use.daemons_s for use in rows.used)),
        ("trainer", sum(use.trainer_s for use in rows.used)),
        ("slots", sum(use.slots_s for use in rows.used)),
    )
    return (
        Figure("rollouts_per_s", 1e3 / _ms_each(rows.at_once), "1/s", Better.HIGHER, count, goal),
        Figure("overhead_ratio", overhead, "share", Better.LOWER, count, OVERHEAD_GOAL),
        *(
            Figure(f"CPU of a rollout: {who}", seconds / count * 1e6, "µs", Better.LOWER, count)
            for who, seconds in parts
        ),
    )


def _ms_each(pushed: Sequence[Pushed]) -> float:
    """The time that all took together, for each rollout."""
    return sum(item.wall_s for item in pushed) / _count(pushed) * 1e3


def _count(pushed: Sequence[Pushed]) -> int:
    return sum(len(item.arrivals) for item in pushed)
