"""The parts of `bench cluster`, each measured on its own: all of them make one result."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.ablation import AblationSizes, bench_ablation
from embomatrix.bench.cluster.flow import FlowSizes, bench_flow
from embomatrix.bench.cluster.overhead import ClusterLoad, bench_cluster_load
from embomatrix.bench.cluster.prewarm import PrewarmSizes, bench_prewarm
from embomatrix.bench.cluster.work import main_work, whole_work
from embomatrix.bench.engine.scenes import scenes_of
from embomatrix.bench.engine.workload import read_workload
from embomatrix.bench.peers.contest import PeerSizes, hold_contest
from embomatrix.bench.peers.page import contest_figures
from embomatrix.world.dataset import Dataset

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from embomatrix.pages.figures import Figure

    OnStep = Callable[[str], None]


class ClusterPart(StrEnum):
    """What can be measured of a cluster, in the order of the page."""

    PHASES = "phases"
    ABLATION = "ablation"
    FLOW = "flow"
    PREWARM = "prewarm"
    PEERS = "peers"


@dataclass(frozen=True, slots=True)
class ClusterJob:
    """What is measured, and on what."""

    dataset: Path
    """Tasks with their oracle plans, for the phases."""
    engine_dataset: Path
    workload: Path
    """The pinned plans for all other parts, and the dataset that they were written for."""
    parts: tuple[ClusterPart, ...] = tuple(ClusterPart)
    load: ClusterLoad = field(default_factory=ClusterLoad)
    ablation: AblationSizes = field(default_factory=AblationSizes)
    prewarm: PrewarmSizes = field(default_factory=PrewarmSizes)
    peers: PeerSizes = field(default_factory=PeerSizes)
    flow: FlowSizes = field(default_factory=FlowSizes)


def bench_cluster_parts(job: ClusterJob, on_step: OnStep) -> tuple[Figure, ...]:
    """Measure the job's parts one after another. Raises what they raise: see each."""
    return tuple(
        figure for part in ClusterPart if part in job.parts for figure in MEASURES[part](job, on_step)
    )


def _phases(job: ClusterJob, on_step: OnStep) -> tuple[Figure, ...]:
    load = job.load
    scenes = scenes_of(Dataset.load(job.dataset), 2 * load.scenes + load.all_slots)
    return bench_cluster_load(scenes, load, on_step)


def _ablation(job: ClusterJob, on_step: OnStep) -> tuple[Figure, ...]:
    work = main_work(Dataset.load(job.engine_dataset), read_workload(job.workload))
    return bench_ablation(work, job.ablation, on_step)


def _flow(job: ClusterJob, on_step: OnStep) -> tuple[Figure, ...]:
    work = main_work(Dataset.load(job.engine_dataset), read_workload(job.workload))
    return bench_flow(work, job.flow, on_step)


def _prewarm(job: ClusterJob, on_step: OnStep) -> tuple[Figure, ...]:
    work = whole_work(Dataset.load(job.engine_dataset), read_workload(job.workload))
    return bench_prewarm(work, job.prewarm, on_step)


def _peers(job: ClusterJob, on_step: OnStep) -> tuple[Figure, ...]:
    work = main_work(Dataset.load(job.engine_dataset), read_workload(job.workload))
    return contest_figures(hold_contest(work, job.peers, on_step))


MEASURES: Final[Mapping[ClusterPart, Callable[[ClusterJob, OnStep], tuple[Figure, ...]]]] = {
    ClusterPart.PHASES: _phases,
    ClusterPart.ABLATION: _ablation,
    ClusterPart.FLOW: _flow,
    ClusterPart.PREWARM: _prewarm,
    ClusterPart.PEERS: _peers,
}
