"""`bench traffic`: recorded traffic of GRPO, replayed through the whole cluster and through other libraries.

Scenes are warm and transition trees are empty when the clock starts. Groups are submitted as the trainer does, eight
in a batch, and as soon as possible: what is measured is the most that the cores allow.
"""

from __future__ import annotations

import asyncio
import logging
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from embomatrix.bench.cluster.cpu import CpuUse, CpuWatch
from embomatrix.bench.cluster.load_generator import LoadGenerator, load_generator
from embomatrix.bench.cluster.processes import bench_cluster
from embomatrix.bench.peers.contenders import ContenderSetup, RolloutChunk
from embomatrix.bench.peers.contest import LIBRARIES, PeerSystem, await_processes, execute, missing, run_apart
from embomatrix.bench.peers.scene_process import write_bundles
from embomatrix.bench.report.figures import BenchError
from embomatrix.bench.traffic.recording import RecordedTraffic
from embomatrix.pages.figures import Better, Figure
from embomatrix.rpc.traffic import SubmittedGroup
from embomatrix.rpc.wire.rollout import merged
from embomatrix.rpc.wire.values import Rollout, RunStats

logger = logging.getLogger(__name__)

RATE_GOAL: Final = 2_000.0
LATE_RATE_GOAL: Final = 3_000.0
SHARE_GOAL: Final = 0.65
LATE_SHARE_GOAL: Final = 0.75
OVERHEAD_GOAL_US: Final = 200.0
LEAD_GOAL: Final = 2.0
ROUND_SEEDS: Final = 2**32
"""Distance of the seeds of two rounds. Seeds of the trainer are smaller."""


@dataclass(frozen=True, slots=True)
class TrafficSizes:
    """Extent of the replay."""

    peers: tuple[PeerSystem, ...] = tuple(PeerSystem)
    slots: int = 2
    rounds: int = 3
    """Replays of each phase, each with seeds of its own: no call is known from the round before."""
    batch: int = 8
    """Groups that are submitted together, as the trainer does."""
    in_flight: int = 8
    """Batches that are submitted before the first of them has its results."""
    start_s: float = 120.0
    """Limit for processes to start and load their scenes."""
    limit_s: float = 300.0
    """Limit for one cluster, or for one peer."""


@dataclass(frozen=True, slots=True)
class PhaseReplay:
    """Measurements of one phase over all rounds."""

    rollouts: int
    walls_s: tuple[float, ...]
    used: CpuUse
    stats: RunStats

    @property
    def rate(self) -> float:
        """Rollouts per second of the median round."""
        return self.rollouts / len(self.walls_s) / float(np.median(self.walls_s))

    @property
    def overhead_us(self) -> float:
        """CPU time of manager, daemon and trainer for each rollout, in microseconds."""
        outside_s = self.used.manager_s + self.used.daemons_s + self.used.trainer_s
        return outside_s / self.rollouts * 1e6


def bench_traffic(
    traffic: RecordedTraffic, sizes: TrafficSizes, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """Measure both phases with and without sharing, and the peers. Raise BenchError if a process ends or a rollout fails."""
    phases = {
        "": (traffic.early, RATE_GOAL, SHARE_GOAL),
        "_late": (traffic.late, LATE_RATE_GOAL, LATE_SHARE_GOAL),
    }
    figures: list[Figure] = []
    shared: dict[str, PhaseReplay] = {}
    for suffix, (groups, rate_goal, share_goal) in phases.items():
        on_step(f"replaying {len(groups)} groups{suffix.replace('_', ', ')}")
        shared[suffix] = found = _replay(traffic, groups, sizes, sharing=True)
        plain = _replay(traffic, groups, sizes, sharing=False)
        count = found.rollouts
        figures += [
            Figure(f"traffic_rollouts_per_s{suffix}", found.rate, "1/s", Better.HIGHER, count, rate_goal),
            Figure(f"traffic_rollouts_per_s{suffix}, no sharing", plain.rate, "1/s", Better.HIGHER, count),
            Figure(
                f"shared_step_share{suffix}",
                found.stats.shared_share,
                "share",
                Better.HIGHER,
                found.stats.steps,
                share_goal,
            ),
            *_costs(suffix, found),
        ]
    for peer in sizes.peers:
        on_step(f"replaying through {peer.value}")
        figures += _lead(peer, traffic, sizes, shared)
    return tuple(figures)


def _costs(suffix: str, found: PhaseReplay) -> list[Figure]:
    goal = OVERHEAD_GOAL_US if suffix else None
    parts = {
        "manager": found.used.manager_s,
        "worker beside its slots": found.used.daemons_s,
        "trainer": found.used.trainer_s,
        "slots": found.used.slots_s,
    }
    phase = "late" if suffix else "early"
    return [
        Figure(f"overhead_cpu_us{suffix}", found.overhead_us, "µs", Better.LOWER, found.rollouts, goal),
        *(
            Figure(
                f"CPU of a rollout, {phase}: {part}",
                seconds / found.rollouts * 1e6,
                "µs",
                Better.LOWER,
                found.rollouts,
            )
            for part, seconds in parts.items()
        ),
    ]


def rounds_of(groups: Sequence[SubmittedGroup], rounds: int) -> list[list[tuple[Rollout, ...]]]:
    """Return the rollouts of each group in each round; later rounds have other seeds."""
    return [
        [
            tuple(replace(one, seed=one.seed + number * ROUND_SEEDS) for one in group.rollouts(f"{number}/"))
            for group in groups
        ]
        for number in range(rounds)
    ]


def _replay(
    traffic: RecordedTraffic, groups: Sequence[SubmittedGroup], sizes: TrafficSizes, *, sharing: bool
) -> PhaseReplay:
    """Replay a phase through a fresh cluster. Without sharing, every rollout is executed from its start."""
    deadline_s = time.monotonic() + sizes.limit_s
    rounds = rounds_of(groups, sizes.rounds)
    with (
        tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name,
        bench_cluster(
            Path(name), workers=1, slots=sizes.slots, deadline_s=deadline_s, sharing=sharing
        ) as cluster,
    ):

        async def measure() -> PhaseReplay:
            opened = load_generator(cluster, traffic.bundles, deadline_s - time.monotonic(), merging=sharing)
            async with opened as load:
                await load.warm_up([rollouts[0] for rollouts in rounds[0]])
                await _touch_scenes(load, rounds[0])
                before = CpuWatch(cluster)
                walls_s = [await _submit(load, one, sizes) for one in rounds]
                used = before.used()
                count = sum(len(rollouts) for one in rounds for rollouts in one)
                return PhaseReplay(count, tuple(walls_s), used, await load.close())

        return asyncio.run(measure())


async def _touch_scenes(load: LoadGenerator, groups: Sequence[Sequence[Rollout]]) -> None:
    """Execute one plan in each scene, with another seed, so that no process is forked on the clock for the first time."""
    firsts = {rollouts[0].bundle_digest: rollouts[0] for rollouts in groups}
    for number in range(2):
        await load.submit(
            [
                replace(one, rollout_id=f"first/{number}/{at}", group_id=f"first/{number}/{at}", seed=at)
                for at, one in enumerate(firsts.values())
            ]
        )


async def _submit(load: LoadGenerator, groups: Sequence[Sequence[Rollout]], sizes: TrafficSizes) -> float:
    """Submit all groups in batches and wait for all results. Return the wall time in seconds."""
    places = asyncio.Semaphore(sizes.in_flight)

    async def one(batch: Sequence[Sequence[Rollout]]) -> None:
        async with places:
            await load.submit([rollout for group in batch for rollout in group])

    started_s = time.perf_counter()
    async with asyncio.TaskGroup() as tasks:
        for start in range(0, len(groups), sizes.batch):
            tasks.create_task(one(groups[start : start + sizes.batch]))
    return time.perf_counter() - started_s


def _lead(
    peer: PeerSystem, traffic: RecordedTraffic, sizes: TrafficSizes, ours: dict[str, PhaseReplay]
) -> list[Figure]:
    found = missing(peer) or run_apart(peer_rates, (peer, traffic, sizes), sizes.limit_s)
    if isinstance(found, str):
        logger.warning("the replay goes without %s: %s", peer.value, found)
        return []
    figures = []
    for suffix, rate in found.items():
        lead = ours[suffix].rate / rate
        count = ours[suffix].rollouts
        figures += [
            Figure(f"traffic_vs_{peer.value}{suffix}", lead, "×", Better.HIGHER, count, LEAD_GOAL),
            Figure(f"traffic through {peer.value}{suffix}, 1/s", rate, "1/s", Better.HIGHER, count),
        ]
    return figures


def peer_rates(peer: PeerSystem, traffic: RecordedTraffic, sizes: TrafficSizes) -> dict[str, float]:
    """Return the peer's rollouts per second in each phase. Equal plans of a group are sent once, as a user would do."""
    with tempfile.TemporaryDirectory(prefix="embo-", ignore_cleanup_errors=True) as name:
        write_bundles(Path(name), traffic.bundles)
        setup = ContenderSetup(Path(name), sizes.slots, tuple(traffic.bundles))
        with LIBRARIES[peer][0](setup) as contender:
            await_processes(contender, sizes.slots, sizes.start_s)
            rates = {}
            for suffix, groups in (("", traffic.early), ("_late", traffic.late)):
                walls_s = []
                for rollouts in rounds_of(groups, sizes.rounds):
                    chunks: list[RolloutChunk] = [tuple(merged(group)) for group in rollouts]
                    outcome = execute(contender, chunks, sizes.limit_s)
                    if outcome.lost or outcome.hung:
                        raise BenchError(f"{peer.value} lost {outcome.lost + outcome.hung} rollouts")
                    walls_s.append(outcome.wall_s)
                count = sum(len(group.members) for group in groups)
                rates[suffix] = count / float(np.median(walls_s))
            return rates
