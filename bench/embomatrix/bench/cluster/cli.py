"""`embomatrix bench cluster`: one command for what a cluster costs, real or simulated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

import typer

from embomatrix.bench.brought import bench_simulation
from embomatrix.bench.cluster.ablation import AblationSizes
from embomatrix.bench.cluster.overhead import ClusterLoad
from embomatrix.bench.cluster.parts import ClusterJob, ClusterPart, bench_cluster_parts
from embomatrix.bench.cluster.prewarm import PrewarmSizes
from embomatrix.bench.engine.workload import PINNED
from embomatrix.bench.peers.contest import PeerSystem
from embomatrix.bench.report.figures import BenchResult, commit_here, describe_machine
from embomatrix.bench.report.output import console, errors, hand_in, refusals

DATASET: Final = Path("build/dataset")
ENGINE_DATASET: Final = Path("build/engine")
SIMULATION_OUT: Final = Path("build/simulation")
LIMIT_S: Final = 120.0
NAIVE: Final = 16

DataSet = Annotated[Path, typer.Option("--dataset", help="Folder that `embomatrix factory build` wrote.")]
EngineDataSet = Annotated[
    Path, typer.Option("--engine-dataset", help="Dataset that the workload was written for.")
]
Work = Annotated[Path, typer.Option("--workload", help="File that `embomatrix bench workload` wrote.")]
Json = Annotated[Path | None, typer.Option("--json", help="File for the figures.")]
LimitS = Annotated[
    float, typer.Option(min=5.0, help="Seconds for one cluster, from its first process to its last result.")
]
Parts = Annotated[
    list[ClusterPart] | None, typer.Option("--part", help="What to measure; may be repeated. [default: all]")
]
Peers = Annotated[
    list[PeerSystem] | None,
    typer.Option("--peer", help="Whom to compare with; may be repeated. [default: all]"),
]
Naive = Annotated[int, typer.Option(min=1, help="Rollouts of the ablation's first row: seconds each.")]


def cluster(
    dataset: DataSet = DATASET,
    engine_dataset: EngineDataSet = ENGINE_DATASET,
    workload: Work = PINNED,
    json_file: Json = None,
    part: Parts = None,
    naive: Naive = NAIVE,
    peer: Peers = None,
    workers: Annotated[int, typer.Option(min=1, max=64, help="Worker daemons of the phases.")] = 2,
    slots: Annotated[int, typer.Option(min=1, max=64, help="Slots of each of them.")] = 1,
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of each phase, at most.")] = 16,
    limit_s: LimitS = LIMIT_S,
    simulate: Annotated[
        bool,
        typer.Option(
            "--simulate", help="Simulate large clusters instead: no dataset, no processes, pictures."
        ),
    ] = False,
    most_workers: Annotated[
        int, typer.Option(min=10, max=100_000, help="Workers of the largest simulated cluster.")
    ] = 10_000,
    out: Annotated[Path, typer.Option(help="Folder for the pictures of the simulation.")] = SIMULATION_OUT,
) -> None:
    """Measure a manager and workers on loopback, the paper's ablation, look-ahead, and peers. Or simulate."""
    with refusals():
        if simulate:
            hand_in(_simulation(out, most_workers), json_file)
            return
        load = ClusterLoad(workers=workers, slots=slots, scenes=scenes, limit_s=limit_s)
        job = cluster_job(dataset, engine_dataset, workload, part, naive, load)
        if peer:
            job = replace(job, peers=replace(job.peers, peers=tuple(peer)))
        hand_in(measure_cluster(job), json_file)


def cluster_job(
    dataset: Path,
    engine_dataset: Path,
    workload: Path,
    parts: list[ClusterPart] | None,
    naive: int,
    load: ClusterLoad,
) -> ClusterJob:
    """What options name, as a job; the load's limit holds for every cluster."""
    return ClusterJob(
        dataset,
        engine_dataset,
        workload,
        tuple(parts or ClusterPart),
        load,
        AblationSizes(naive=naive, limit_s=load.limit_s),
        PrewarmSizes(limit_s=load.limit_s),
    )


def measure_cluster(job: ClusterJob) -> BenchResult:
    """The figures of the job's parts, with progress for a person."""
    machine = describe_machine() | {"workers": job.load.workers, "slots_each": job.load.slots}
    with errors.status("cluster") as status:

        def on_step(what: str) -> None:
            status.update(f"cluster: {what}")

        return BenchResult("cluster", commit_here(), machine, bench_cluster_parts(job, on_step))


def _simulation(out: Path, most_workers: int) -> BenchResult:
    machine = describe_machine() | {"most_workers": most_workers}
    with errors.status("simulated cluster") as status:

        def on_step(what: str) -> None:
            status.update(f"simulated cluster: {what}")

        figures = bench_simulation(out, most_workers, on_step)
    console.print(f"pictures are in {out}", highlight=False)
    return BenchResult("simulated-cluster", commit_here(), machine, figures)
