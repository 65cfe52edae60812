"""`embomatrix demo`: dataset, local cluster and training in one go, each by the same commands that a person would use."""

from __future__ import annotations

import itertools
import logging
import os
import time
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console
from rich.logging import RichHandler

from embomatrix.cli.failure import fail
from embomatrix.cli.local_cluster import LocalCluster, cluster_problem, local_cluster, no_problem, run_command

DEFAULT_OUT: Final = Path("runs/demo")
TASKS: Final = 960
"""Tasks to train on. Of half as many a policy learns the plans by heart before it has learnt to read."""
console = Console()


_Out = Annotated[
    Path | None,
    typer.Option(help=f"Folder for everything that the run writes; else {DEFAULT_OUT}, or -2, -3 ..."),
]
_Dataset = Annotated[Path, typer.Option(help="Dataset folder; built first when it is missing.")]
_Workers = Annotated[int, typer.Option(min=1, max=64, help="Worker daemons on this machine.")]
_Slots = Annotated[int, typer.Option(min=1, max=64, help="Slots of each worker.")]
_Minutes = Annotated[float, typer.Option(min=0.1, help="Minutes of GRPO.")]
_ImitateSeconds = Annotated[float, typer.Option(min=0.0, help="Seconds of imitation before it.")]
_Model = Annotated[str, typer.Option(help="`tiny`, or a Hugging Face name or folder.")]
_Seed = Annotated[int, typer.Option(help="Seed of tasks, policy and sampling.")]
_Threads = Annotated[int, typer.Option(min=0, help="Threads of torch in each process; 0: half of the cores.")]


def demo(
    out: _Out = None,
    dataset: _Dataset = Path("build/dataset"),
    workers: _Workers = 2,
    slots: _Slots = 1,
    minutes: _Minutes = 5.5,
    imitate_seconds: _ImitateSeconds = 80.0,
    model: _Model = "tiny",
    seed: _Seed = 0,
    threads: _Threads = 0,
) -> None:
    """Bring up a local cluster and train on real tasks, from nothing to a report."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[RichHandler(show_path=False)])
    # Threads that spin while they wait would take the cores from the simulators.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    folder = _folder(out)
    started_s = time.monotonic()
    _ensure_tasks(dataset, seed)
    built_s = time.monotonic()
    cluster = local_cluster(folder / "cluster", workers=workers, slots=slots, dataset=dataset)
    with cluster.supervisor:
        _announce(cluster, slots)
        how = [
            f"--model={model}",
            f"--minutes={minutes}",
            f"--imitate-seconds={imitate_seconds}",
            f"--seed={seed}",
        ]
        if threads:
            how.append(f"--threads={threads}")
        where = [f"--dataset={dataset}", f"--manager={cluster.address}", f"--out={folder}"]
        run_command("demo", lambda: cluster_problem(cluster), "train", *where, *how)
        _report_restarts(cluster)
    ended_s = time.monotonic()
    console.print(
        f"tasks {built_s - started_s:.0f} s, training {ended_s - built_s:.0f} s, logs in {folder / 'cluster' / 'logs'}",
        highlight=False,
    )


def _ensure_tasks(dataset: Path, seed: int) -> None:
    """Build the dataset where there is none."""
    if (dataset / "tasks.jsonl").exists():
        return
    console.rule("tasks")
    # A run to look at: what the arm of physical mode could not do after all is not looked for.
    where = [f"--out={dataset}", f"--seed={seed}"]
    run_command("demo", no_problem, "factory", "build", *where, f"--train={TASKS}", "--no-look-ahead")


def _announce(cluster: LocalCluster, slots: int) -> None:
    console.rule("training")
    workers = f"{len(cluster.workers)} workers of {slots} slot{'s' * (slots > 1)}"
    console.print(
        f"manager at {cluster.address}, {workers}, dashboard at {cluster.dashboard}",
        highlight=False,
    )


def _report_restarts(cluster: LocalCluster) -> None:
    for name in ("manager", *cluster.workers):
        count = cluster.supervisor.restarts(name)
        if count:
            console.print(f"{name} died and was started anew {count} times", highlight=False)


def _folder(wanted: Path | None) -> Path:
    """A folder without a run in it: the one that is wanted, or the first free one of the default's name."""
    if wanted is not None:
        if _holds_run(wanted):
            fail("demo", f"{wanted} holds another run: pass another --out, or remove the folder")
        folder = wanted
    else:
        names = (DEFAULT_OUT.with_name(f"{DEFAULT_OUT.name}-{number}") for number in itertools.count(2))
        folder = next(name for name in itertools.chain([DEFAULT_OUT], names) if not _holds_run(name))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fail("demo", f"the folder {folder} can't be made ({error.strerror}): pass another --out")
    return folder


def _holds_run(folder: Path) -> bool:
    return any((folder / "checkpoints").glob("step-*"))
