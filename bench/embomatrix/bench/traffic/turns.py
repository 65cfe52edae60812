"""Latency and throughput of closed-loop episodes on a cluster: single calls of 20-call episodes, and many episodes at once.

Manager, worker and client share this machine's cores. Slots share calls, as they do by default: without that, each turn would
execute its whole prefix. No episode is played twice.
"""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.load_generator import load_generator
from embomatrix.bench.cluster.processes import bench_cluster
from embomatrix.bench.report.figures import quantile
from embomatrix.pages.figures import Better, Figure
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.episodes import Episodes

if TYPE_CHECKING:
    from embomatrix.bench.engine.workload import Execution, SceneWork, Workload
    from embomatrix.skills.syntax import Plan

STEP_GOAL_MS: Final = 5.0
RATE_GOAL: Final = 1_500.0


@dataclass(frozen=True, slots=True)
class TurnSizes:
    """Episodes of each part. ``calls`` is the length of an episode."""

    calls: int = 20
    alone: int = 30
    """Episodes played one after another."""
    together: int = 64
    """Episodes played at the same time."""
    rounds: int = 8
    """Episodes that each of those plays."""
    slots: int = 2
    limit_s: float = 120.0


@dataclass(frozen=True, slots=True)
class EpisodeScript:
    """Calls of one episode."""

    bundle_digest: str
    task_id: str
    seed: int
    calls: Plan


def bench_turns(workload: Workload, sizes: TurnSizes, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Measure the workload's main scenes.

    Raise BenchError if a process ends or the time is up, ClusterError for a failed turn.
    """
    deadline_s = time.monotonic() + sizes.limit_s
    main = workload.main
    scripts = episode_scripts(main, sizes.calls)
    digests = {scene.bundle_digest for scene in main.scenes}
    bundles = {digest: data for digest, data in workload.bundles.items() if digest in digests}
    with (
        tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name,
        bench_cluster(
            Path(name), workers=1, slots=sizes.slots, deadline_s=deadline_s, sharing=True
        ) as cluster,
    ):

        async def measure() -> tuple[Figure, ...]:
            async with load_generator(cluster, bundles, deadline_s - time.monotonic()) as load:
                await load.warm_up(main.rollouts)
                async with ClusterClient(cluster.address) as client:
                    run_id = await client.open_run("turns")
                    async with Episodes(client, run_id) as episodes:
                        return await _measured(episodes, scripts, sizes, on_step)

        return asyncio.run(measure())


def episode_scripts(workload: Workload, calls: int) -> Iterator[EpisodeScript]:
    """Yield the scripts of episodes without end, in turn from each scene, and no two with equal task and seed.

    Each joins plans of one task: calls that do not fit the state fail, and the episode goes on.
    """
    return _alternating([_scripts_of(scene, calls) for scene in workload.scenes])


def _scripts_of(scene: SceneWork, calls: int) -> Iterator[EpisodeScript]:
    by_task: dict[str, list[Execution]] = defaultdict(list)
    for execution in scene.executions:
        by_task[execution.task_id].append(execution)
    most = 1 + max(execution.seed for execution in scene.executions)
    number = 0
    while True:
        for at, execution in enumerate(scene.executions):
            same = by_task[execution.task_id]
            rest = (call for other in islice(cycle(same), at, None) for call in other.plan)
            plan = tuple(islice((call for part in (execution.plan, rest) for call in part), calls))
            yield EpisodeScript(scene.bundle_digest, execution.task_id, execution.seed + number * most, plan)
        number += 1


def _alternating(sources: Sequence[Iterator[EpisodeScript]]) -> Iterator[EpisodeScript]:
    while True:
        for source in sources:
            yield next(source)


async def _measured(
    episodes: Episodes, scripts: Iterator[EpisodeScript], sizes: TurnSizes, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    await _together(episodes, scripts, sizes.together, 1)  # slots are forked and have loaded all code
    on_step("episodes one after another")
    waits_s = [wait_s for _ in range(sizes.alone) for wait_s in await _play(episodes, next(scripts))]
    on_step(f"{sizes.together} episodes at a time")
    began_s = time.perf_counter()
    many_s = await _together(episodes, scripts, sizes.together, sizes.rounds)
    wall_s = time.perf_counter() - began_s
    turns = len(many_s)
    return (
        Figure("step_p50_ms", quantile(waits_s, 0.5) * 1e3, "ms", Better.LOWER, len(waits_s), STEP_GOAL_MS),
        Figure("step_p99_ms", quantile(waits_s, 0.99) * 1e3, "ms", Better.LOWER, len(waits_s)),
        Figure("turns_per_s", turns / wall_s, "1/s", Better.HIGHER, turns, RATE_GOAL),
        Figure(
            f"turn of {sizes.together} episodes, median",
            quantile(many_s, 0.5) * 1e3,
            "ms",
            Better.LOWER,
            turns,
        ),
    )


async def _together(
    episodes: Episodes, scripts: Iterator[EpisodeScript], count: int, rounds: int
) -> list[float]:
    """Play ``count`` episodes at a time, ``rounds`` of them one after another. Return the seconds of each turn."""

    async def play() -> list[float]:
        return [wait_s for _ in range(rounds) for wait_s in await _play(episodes, next(scripts))]

    played = await asyncio.gather(*(play() for _ in range(count)))
    return [wait_s for each in played for wait_s in each]


async def _play(episodes: Episodes, script: EpisodeScript) -> list[float]:
    """Play one episode call by call. Return the seconds of each turn."""
    episode = episodes.begin(script.bundle_digest, script.task_id, script.seed)
    waits_s = []
    for call in script.calls:
        began_s = time.perf_counter()
        await episode.act((call,))
        waits_s.append(time.perf_counter() - began_s)
    return waits_s
