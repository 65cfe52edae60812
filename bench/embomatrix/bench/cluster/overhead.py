"""`bench cluster`: what the cluster adds to a rollout, with and without look-ahead, through real processes on loopback."""

from __future__ import annotations

import asyncio
import itertools
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.load_generator import connected
from embomatrix.bench.cluster.processes import bench_cluster
from embomatrix.bench.report.figures import BenchError, quantile_figure
from embomatrix.pages.figures import Better, Figure
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import (
    Batch,
    Completed,
    LookaheadEntry,
    ResidentState,
    Rollout,
    RunStats,
    Warmth,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from embomatrix.bench.cluster.processes import BenchCluster
    from embomatrix.bench.engine.scenes import BenchScene
    from embomatrix.rpc.wire.values import RolloutResult

LOADED_GOAL_MS: Final = 60.0
"""Fetching, forking and loading a scene on a worker."""
ALONE_GOAL_MS: Final = 5.0
RATE_GOAL_PER_SLOT: Final = 500.0
OVERHEAD_GOAL: Final = 0.2
HITS_GOAL: Final = 0.95
LEAST_SCENES: Final = 3
"""One to warm up with, one that comes unannounced and one that is announced."""
POLL_S: Final = 0.005


@dataclass(frozen=True, slots=True)
class ClusterLoad:
    """What is brought up and pushed through. ``scenes`` bounds the scenes of each phase."""

    workers: int = 2
    slots: int = 1
    scenes: int = 16
    group: int = 8
    """Rollouts of one task in one batch."""
    alone: int = 40
    """Rollouts with nothing else under way."""
    steady: int = 200
    """Rollouts of each slot's one group in the last phase."""
    limit_s: float = 60.0
    """For everything, from the first process to the last result."""

    @property
    def all_slots(self) -> int:
        return self.workers * self.slots


@dataclass(frozen=True, slots=True)
class RolloutGroup:
    """``count`` rollouts of one scene's first oracle plan."""

    scene: BenchScene
    count: int


@dataclass(frozen=True, slots=True)
class RunMeasurement:
    """What came of one run. Latency is from a batch's submission to the result of one of its rollouts."""

    latency_s: tuple[float, ...]
    execute_s: tuple[float, ...]
    """Of the same rollouts, in the slot."""
    wall_s: float
    lost: int
    stats: RunStats
    slots: int

    @property
    def rate(self) -> float:
        """Rollouts per second."""
        return len(self.latency_s) / self.wall_s

    @property
    def mean_s(self) -> float:
        return sum(self.latency_s) / len(self.latency_s)

    @property
    def overhead(self) -> float:
        """Share of the slots' time in which they executed nothing: (wall - execution of a slot) / wall."""
        return 1.0 - sum(self.execute_s) / self.slots / self.wall_s

    @property
    def hits(self) -> float:
        """Share of the scenes that were warm on a worker when their batch came."""
        return self.stats.prewarm_hits / max(1, self.stats.prewarm_hits + self.stats.prewarm_misses)


def bench_cluster_load(
    scenes: Sequence[BenchScene], load: ClusterLoad, on_phase: Callable[[str], None]
) -> tuple[Figure, ...]:
    """Bring a cluster up and push batches through it. ``on_phase`` hears what is being done.

    Raises BenchError when a process dies, the time is up, or there are too few scenes; ClusterError for a call refused.
    """
    if len(scenes) < LEAST_SCENES:
        raise BenchError(
            f"the dataset has too few scenes, {len(scenes)}: expected at least {LEAST_SCENES}, since each is cold only once"
        )
    deadline_s = time.monotonic() + load.limit_s
    on_phase("starting manager and workers")
    with (
        tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name,
        bench_cluster(Path(name), workers=load.workers, slots=load.slots, deadline_s=deadline_s) as cluster,
    ):
        return asyncio.run(_measure(cluster, scenes, load, deadline_s, on_phase))


async def _measure(
    cluster: BenchCluster,
    scenes: Sequence[BenchScene],
    load: ClusterLoad,
    deadline_s: float,
    on_phase: Callable[[str], None],
) -> tuple[Figure, ...]:
    doing = "connecting the workers"

    def begin(what: str) -> None:
        nonlocal doing
        doing = what
        on_phase(what)

    try:
        async with asyncio.timeout(deadline_s - time.monotonic()), ClusterClient(cluster.address) as client:
            await connected(client, cluster)
            await client.put_bundles({scene.bundle_digest: scene.data for scene in scenes})
            return await _phases(BatchDriver(client, load.all_slots), scenes, load, begin)
    except TimeoutError:
        cluster.check()
        raise BenchError(
            f"the bench took longer than {load.limit_s:g} s and was ended while {doing}: "
            "ask for fewer --scenes or allow more with --limit-s"
        ) from None


async def _phases(
    session: BatchDriver, scenes: Sequence[BenchScene], load: ClusterLoad, begin: Callable[[str], None]
) -> tuple[Figure, ...]:
    spare = load.all_slots if len(scenes) >= LEAST_SCENES * load.all_slots else 1
    # By turns, so that large and small scenes are shared out alike.
    unannounced, announced = scenes[spare::2][: load.scenes], scenes[spare + 1 :: 2][: load.scenes]
    steps = session.steps(announced, load.group)
    begin("warming up")
    await session.execute("warm-up", session.steps(scenes[:spare], 1))
    begin("executing in scenes that nobody announced")
    cold = await session.execute("cold", session.steps(unannounced, load.group))
    begin("announcing scenes and executing in them")
    prewarmed, prewarm_s = await session.execute_announced("prewarmed", steps)
    begin("executing in the same scenes again")
    repeated = await session.execute("repeated", steps)
    begin("executing one rollout at a time")
    alone = await session.execute("alone", [(RolloutGroup(announced[-1], 1),)] * load.alone)
    begin("executing many plans of one group for each slot")
    steady = await session.execute("steady", session.steps(announced[-load.all_slots :], load.steady))
    loads_s = await session.loads_s()
    return (
        *_phase_figures("cold", cold, hits_goal=None),
        *_phase_figures("prewarmed", prewarmed, hits_goal=HITS_GOAL),
        *_phase_figures("repeated", repeated, hits_goal=HITS_GOAL),
        *_peak_figures(steady, alone, load),
        quantile_figure("scene resident on a worker: fetch, fork, load", loads_s, 0.5, "ms", LOADED_GOAL_MS),
        _rate("scenes warmed ahead", len(announced) / prewarm_s, len(announced)),
        _ratio("latency, cold over prewarmed", cold.mean_s / prewarmed.mean_s, cold),
        _ratio("latency, cold over repeated", cold.mean_s / repeated.mean_s, cold),
        _ratio("rollouts/s, prewarmed over cold", prewarmed.rate / cold.rate, prewarmed),
        _ratio("rollouts/s, steady over cold", steady.rate / cold.rate, steady),
        _lost(cold, prewarmed, repeated, alone, steady),
    )


def _phase_figures(name: str, phase: RunMeasurement, hits_goal: float | None) -> tuple[Figure, ...]:
    count, scenes = len(phase.latency_s), phase.stats.prewarm_hits + phase.stats.prewarm_misses
    return (
        Figure(f"{name}: latency of a rollout, mean", phase.mean_s * 1e3, "ms", Better.LOWER, count),
        quantile_figure(f"{name}: latency of a rollout", phase.latency_s, 0.95, "ms"),
        _rate(f"{name}: rollouts", phase.rate, count),
        Figure(f"{name}: scenes warm on arrival", phase.hits, "share", Better.HIGHER, scenes, hits_goal),
        Figure(f"{name}: overhead", phase.overhead, "share", Better.LOWER, count),
    )


def _peak_figures(steady: RunMeasurement, alone: RunMeasurement, load: ClusterLoad) -> tuple[Figure, ...]:
    count, goal = len(steady.latency_s), RATE_GOAL_PER_SLOT * load.all_slots
    between_s = [whole - slot for whole, slot in zip(alone.latency_s, alone.execute_s, strict=True)]
    return (
        Figure("steady: rollouts", steady.rate, "1/s", Better.HIGHER, count, goal),
        Figure("steady: overhead", steady.overhead, "share", Better.LOWER, count, OVERHEAD_GOAL),
        quantile_figure("alone: latency of a rollout", alone.latency_s, 0.5, "ms", ALONE_GOAL_MS),
        quantile_figure("alone: latency beside the slot's execution", between_s, 0.5, "ms"),
    )


def _rate(name: str, value: float, n: int) -> Figure:
    return Figure(name, value, "1/s", Better.HIGHER, n)


def _ratio(name: str, value: float, phase: RunMeasurement) -> Figure:
    return Figure(name, value, "×", Better.HIGHER, len(phase.latency_s))


def _lost(*phases: RunMeasurement) -> Figure:
    count = sum(len(phase.latency_s) + phase.lost for phase in phases)
    return Figure(
        "rollouts without a result", sum(phase.lost for phase in phases), "count", Better.LOWER, count, 0.0
    )


class BatchDriver:
    """Pushes batches through one client, as a trainer does: a step's groups at once, the next step when all are in."""

    def __init__(self, client: ClusterClient, slots: int) -> None:
        self._client = client
        self._slots = slots

    def steps(self, scenes: Sequence[BenchScene], count: int) -> list[tuple[RolloutGroup, ...]]:
        """Steps of one group for each slot, a scene to a group."""
        groups = [RolloutGroup(scene, count) for scene in scenes]
        return [tuple(groups[start : start + self._slots]) for start in range(0, len(groups), self._slots)]

    async def execute(self, name: str, steps: Sequence[tuple[RolloutGroup, ...]]) -> RunMeasurement:
        """Execute the steps in a run of their own. Raises BenchError when not one rollout has a result."""
        return await self._execute(await self._client.open_run(name), steps)

    async def execute_announced(
        self, name: str, steps: Sequence[tuple[RolloutGroup, ...]]
    ) -> tuple[RunMeasurement, float]:
        """Announce the steps, wait until their scenes are warm, then execute; also tells the seconds of the wait."""
        run_id = await self._client.open_run(name)
        entries = [
            LookaheadEntry(number, group.scene.bundle_digest, group.count)
            for number, groups in enumerate(steps, start=1)
            for group in groups
        ]
        started_s = time.perf_counter()
        for version in itertools.count(1):
            told = await self._client.announce_lookahead(run_id, version, entries)
            if all(warmth is Warmth.WARM for warmth in told.values()):
                break
            if Warmth.UNPLACEABLE in told.values():
                raise BenchError("a scene fits on no worker: free some memory, or ask for fewer --scenes")
            await asyncio.sleep(POLL_S)
        prewarm_s = time.perf_counter() - started_s
        return await self._execute(run_id, steps), prewarm_s

    async def loads_s(self) -> list[float]:
        """Seconds that each resident scene of every worker took to fetch and load."""
        return [
            resident.load_s
            for worker in await self._client.list_workers()
            for resident in worker.residents
            if resident.state is ResidentState.WARM
        ]

    async def _execute(self, run_id: str, steps: Sequence[tuple[RolloutGroup, ...]]) -> RunMeasurement:
        answers: list[tuple[float, RolloutResult]] = []
        started_s = time.perf_counter()
        for step, groups in enumerate(steps, start=1):
            batches = [_batch(run_id, step, index, group) for index, group in enumerate(groups)]
            await self._execute_step(batches, answers)
        wall_s = time.perf_counter() - started_s
        done = [(s, result.outcome) for s, result in answers if isinstance(result.outcome, Completed)]
        if not done:
            raise BenchError(f"no rollout of {len(answers)} had a result: {answers[0][1].outcome}")
        return RunMeasurement(
            latency_s=tuple(latency_s for latency_s, _ in done),
            execute_s=tuple(outcome.timings.execute_s for _, outcome in done),
            wall_s=wall_s,
            lost=len(answers) - len(done),
            stats=await self._client.close_run(run_id),
            slots=self._slots,
        )

    async def _execute_step(
        self, batches: Sequence[Batch], answers: list[tuple[float, RolloutResult]]
    ) -> None:
        try:
            async with asyncio.TaskGroup() as tasks:
                for batch in batches:
                    tasks.create_task(self._submit(batch, answers))
        except ExceptionGroup as errors:
            raise errors.exceptions[0] from errors

    async def _submit(self, batch: Batch, answers: list[tuple[float, RolloutResult]]) -> None:
        started_s = time.perf_counter()
        async for result in self._client.execute(batch):
            answers.append((time.perf_counter() - started_s, result))


def _batch(run_id: str, step: int, index: int, group: RolloutGroup) -> Batch:
    batch_id = f"{step}-{index}"
    shown = group.scene.demonstrations[0]
    first = Rollout(
        rollout_id="0",
        group_id=f"{run_id}/{batch_id}",
        bundle_digest=group.scene.bundle_digest,
        task_id=shown.task_id,
        plan=shown.plan,
        seed=step,
    )
    rollouts = tuple(replace(first, rollout_id=f"{first.group_id}/{number}") for number in range(group.count))
    return Batch(run_id, batch_id, step, rollouts)
