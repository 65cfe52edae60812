"""`embomatrix demo`: dataset, local cluster and training in one go, each by the same commands that a person would use."""

from __future__ import annotations

import logging
import subprocess
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.logging import RichHandler

from embomatrix.cli.local_cluster import LocalCluster, local_cluster
from embomatrix.cli.supervisor import embomatrix_command

console = Console()


def demo(
    out: Annotated[Path, typer.Option(help="Folder for everything that the run writes.")] = Path("runs/demo"),
    dataset: Annotated[Path, typer.Option(help="Dataset folder; built first when it is missing.")] = Path(
        "build/dataset"
    ),
    workers: Annotated[int, typer.Option(min=1, max=64, help="Worker daemons on this machine.")] = 2,
    slots: Annotated[int, typer.Option(min=1, max=64, help="Slots of each worker.")] = 1,
    minutes: Annotated[float, typer.Option(min=0.1, help="Minutes of GRPO.")] = 5.0,
    imitate_seconds: Annotated[float, typer.Option(min=0.0, help="Seconds of imitation before it.")] = 150.0,
    model: Annotated[str, typer.Option(help="`tiny`, or a Hugging Face name or folder.")] = "tiny",
    seed: Annotated[int, typer.Option(help="Seed of tasks, policy and sampling.")] = 0,
) -> None:
    """Bring up a local cluster and train on real tasks, from nothing to a report."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[RichHandler(show_path=False)])
    started_s = time.monotonic()
    if not (dataset / "tasks.jsonl").exists():
        console.rule("tasks")
        _run("factory", "build", f"--out={dataset}", f"--seed={seed}")
    built_s = time.monotonic()
    cluster = local_cluster(out / "cluster", workers=workers, slots=slots)
    with cluster.supervisor:
        console.rule("training")
        console.print(
            f"manager at {cluster.address}, {workers} workers of {slots} slot, dashboard at {cluster.dashboard}",
            highlight=False,
        )
        _run(
            "train",
            f"--dataset={dataset}",
            f"--manager={cluster.address}",
            f"--model={model}",
            f"--minutes={minutes}",
            f"--imitate-seconds={imitate_seconds}",
            f"--out={out}",
            f"--seed={seed}",
        )
        _report_restarts(cluster)
    ended_s = time.monotonic()
    console.print(
        f"tasks {built_s - started_s:.0f} s, training {ended_s - built_s:.0f} s, logs in {out / 'cluster' / 'logs'}",
        highlight=False,
    )


def _report_restarts(cluster: LocalCluster) -> None:
    for name in ("manager", *cluster.workers):
        count = cluster.supervisor.restarts(name)
        if count:
            console.print(f"{name} died and was started anew {count} times", highlight=False)


def _run(*arguments: str) -> None:
    """Run one `embomatrix` command in the foreground; its failure is ours, with its own message and status."""
    status = subprocess.run(embomatrix_command(*arguments), check=False).returncode
    if status:
        raise SystemExit(status)
