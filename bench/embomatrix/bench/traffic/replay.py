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
from embomatrix.skills.syntax import MAX_STEPS, Skill, SkillCall

logger = logging.getLogger(__name__)

RATE_GOAL: Final = 2_000.0
LATE_RATE_GOAL: Final = 3_000.0
SHARE_GOAL: Final = 0.65
LATE_SHARE_GOAL: Final = 0.75
OVERHEAD_GOAL_US: Final = 200.0
LEAD_GOAL: Final = 2.0


@dataclass(frozen=True, slots=True)
class TrafficSizes:
    """Extent of the replay."""

    peers: tuple[PeerSystem, ...] = tuple(PeerSystem)
    slots: int = 2
    rounds: int = 3
    """Replays of each phase, each through a new cluster: no call is known from the round before."""
    warm: int = 4
    """Rounds that reach other states first. A process copies most of its pages in its first fifty rollouts."""
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
    """Rollouts of one round."""
    walls_s: tuple[float, ...]
    used: tuple[CpuUse, ...]
    stats: RunStats
    """Counters of the last round."""

    @property
    def count(self) -> int:
        """Rollouts of all rounds."""
        return self.rollouts * len(self.walls_s)

    @property
    def rate(self) -> float:
        """Rollouts per second of the median round."""
        return self.rollouts / float(np.median(self.walls_s))

    @property
    def overhead_us(self) -> float:
        """CPU time of manager, daemon and trainer for each rollout of the median round, in microseconds."""
        outside_s = [used.manager_s + used.daemons_s + used.trainer_s for used in self.used]
        return float(np.median(outside_s)) / self.rollouts * 1e6


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
        count = found.count
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
    phase, goal = ("late", OVERHEAD_GOAL_US) if suffix else ("early", None)
    parts = {
        "manager": [used.manager_s for used in found.used],
        "worker beside its slots": [used.daemons_s for used in found.used],
        "trainer": [used.trainer_s for used in found.used],
        "slots": [used.slots_s for used in found.used],
    }

    def figure(name: str, value_us: float, goal_us: float | None = None) -> Figure:
        return Figure(name, value_us, "µs", Better.LOWER, found.count, goal_us)

    return [
        figure(f"overhead_cpu_us{suffix}", found.overhead_us, goal),
        *(
            figure(f"CPU of a rollout, {phase}: {part}", float(np.median(seconds)) / found.rollouts * 1e6)
            for part, seconds in parts.items()
        ),
    ]


def _replay(
    traffic: RecordedTraffic, groups: Sequence[SubmittedGroup], sizes: TrafficSizes, *, sharing: bool
) -> PhaseReplay:
    """Replay a phase through fresh clusters. Without sharing, every rollout is executed from its start."""
    rounds = [_round(traffic, groups, sizes, sharing=sharing) for _ in range(sizes.rounds)]
    walls_s, used, stats = zip(*rounds, strict=True)
    return PhaseReplay(sum(len(group.members) for group in groups), walls_s, used, stats[-1])


def _round(
    traffic: RecordedTraffic, groups: Sequence[SubmittedGroup], sizes: TrafficSizes, *, sharing: bool
) -> tuple[float, CpuUse, RunStats]:
    deadline_s = time.monotonic() + sizes.limit_s
    rollouts = [group.rollouts() for group in groups]
    with (
        tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name,
        bench_cluster(
            Path(name), workers=1, slots=sizes.slots, deadline_s=deadline_s, sharing=sharing
        ) as cluster,
    ):

        async def measure() -> tuple[float, CpuUse, RunStats]:
            opened = load_generator(cluster, traffic.bundles, deadline_s - time.monotonic(), merging=sharing)
            async with opened as load:
                await load.warm_up([group[0] for group in rollouts])
                for number in range(sizes.warm):
                    await _submit(load, [elsewhere(group, number) for group in rollouts], sizes)
                before = CpuWatch(cluster)
                wall_s = await _submit(load, rollouts, sizes)
                return wall_s, before.used(), await load.close()

        return asyncio.run(measure())


def elsewhere(rollouts: Sequence[Rollout], number: int) -> list[Rollout]:
    """Return the rollouts with another first call, for each ``number`` a different one.

    No state that they reach is one that the originals reach.
    """
    turn = SkillCall(Skill.TURN, yaw=0.1 * (number + 1))
    return [
        replace(
            one,
            rollout_id=f"{number}/{one.rollout_id}",
            group_id=f"{number}/{one.group_id}",
            plan=(turn, *one.plan)[:MAX_STEPS],
        )
        for one in rollouts
    ]


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
        count = ours[suffix].count
        figures += [
            Figure(f"traffic_vs_{peer.value}{suffix}", lead, "×", Better.HIGHER, count, LEAD_GOAL),
            Figure(f"traffic through {peer.value}{suffix}, 1/s", rate, "1/s", Better.HIGHER, count),
        ]
    return figures


def peer_rates(peer: PeerSystem, traffic: RecordedTraffic, sizes: TrafficSizes) -> dict[str, float]:
    """Return the peer's rollouts per second in each phase, of rounds like ours.

    Equal plans of a group are sent once, as a user would do.
    """
    rates = {}
    for suffix, groups in (("", traffic.early), ("_late", traffic.late)):
        count = sum(len(group.members) for group in groups)
        walls_s = [_peer_round_s(peer, traffic, groups, sizes) for _ in range(sizes.rounds)]
        rates[suffix] = count / float(np.median(walls_s))
    return rates


def _peer_round_s(
    peer: PeerSystem, traffic: RecordedTraffic, groups: Sequence[SubmittedGroup], sizes: TrafficSizes
) -> float:
    """Wall time of one round in new processes."""
    with tempfile.TemporaryDirectory(prefix="embo-", ignore_cleanup_errors=True) as name:
        write_bundles(Path(name), traffic.bundles)
        setup = ContenderSetup(Path(name), sizes.slots, tuple(traffic.bundles))
        with LIBRARIES[peer][0](setup) as contender:
            await_processes(contender, sizes.slots, sizes.start_s)
            chunks: list[RolloutChunk] = [tuple(merged(group.rollouts())) for group in groups]
            for number in range(sizes.warm):
                execute(contender, [tuple(elsewhere(chunk, number)) for chunk in chunks], sizes.limit_s)
            outcome = execute(contender, chunks, sizes.limit_s)
            if outcome.lost or outcome.hung:
                raise BenchError(f"{peer.value} lost {outcome.lost + outcome.hung} rollouts")
            return outcome.wall_s
