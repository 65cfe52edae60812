"""`embomatrix demo`: dataset, local cluster and training in one command, by the same commands that users run."""

import itertools
import logging
import math
import os
import time
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console
from rich.logging import RichHandler

from embomatrix.cli.local_cluster import LocalCluster, cluster_problem, local_cluster, run_command
from embomatrix.envs.rules import Visibility
from embomatrix.host.failure import fail
from embomatrix.starter.options import DATASET_VARIABLE, DEFAULT_DATASET
from embomatrix.starter.shipped import demo_settings, is_named, unpack
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError

DEFAULT_OUT: Final = Path("runs/demo")
IMITATION_STEPS: Final = 340
GRPO_STEPS: Final = 90
"""Budgets in steps: the same seed gives the same curve on a fast machine and on a slow one."""
EVALUATE_EVERY: Final = 45
"""Steps of GRPO between evaluations: one beside those before and after, in twenty seconds."""
console = Console()


def demo(
    out: Annotated[
        Path | None,
        typer.Option(help=f"Output folder. Default: {DEFAULT_OUT}, or the first free {DEFAULT_OUT}-2, -3 …"),
    ] = None,
    dataset: Annotated[
        Path,
        typer.Option(
            help="Folder of the dataset, or `search`. If it is missing, the shipped tasks are unpacked there.",
            envvar=DATASET_VARIABLE,
        ),
    ] = DEFAULT_DATASET,
    workers: Annotated[int, typer.Option(min=1, max=64, help="Workers on this machine.")] = 2,
    slots: Annotated[int, typer.Option(min=1, max=64, help="Slots per worker.")] = 1,
    steps: Annotated[int, typer.Option(min=0, help="Steps of GRPO.")] = GRPO_STEPS,
    imitate_steps: Annotated[
        int, typer.Option(min=0, help="Steps of imitation before GRPO.")
    ] = IMITATION_STEPS,
    episodes: Annotated[
        Visibility | None,
        typer.Option(
            help="Train call by call, told of all objects or of those seen. Takes longer than plans."
        ),
    ] = None,
    teacher_rounds: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=100,
            help="Rounds in which the oracle finishes episodes that the policy began (with --episodes). Default: 0.",
        ),
    ] = None,
    model: Annotated[str, typer.Option(help="`tiny`, or a Hugging Face model by name or folder.")] = "tiny",
    seed: Annotated[int, typer.Option(help="Random seed of policy and sampling.")] = 0,
    threads: Annotated[
        int, typer.Option(min=0, help="torch threads per process. 0: half of the cores in all.")
    ] = 0,
) -> None:
    """Start a local cluster and train on real tasks, from nothing to a report."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[RichHandler(show_path=False)])
    # Waiting threads must not spin: the simulators need the cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    folder = _folder(out)
    started_s = time.monotonic()
    ships = is_named(dataset)
    if not ships:
        _ensure_tasks(dataset)
    built_s = time.monotonic()
    cluster = local_cluster(folder / "cluster", workers=workers, slots=slots, dataset=dataset)
    with cluster.supervisor:
        _announce(cluster, slots)
        minutes = None if ships or episodes else _minutes(dataset, model, imitate_steps, steps)
        options = [
            f"--model={model}",
            f"--steps={steps}",
            f"--imitate-steps={imitate_steps}",
            f"--seed={seed}",
            f"--evaluate-every={EVALUATE_EVERY}",
            *([f"--settings={demo_settings()}"] if model == "tiny" else []),
        ]
        if minutes is not None:
            console.print(
                f"about {minutes} minutes on two cores: imitation, GRPO and evaluations. The clock only warns: the run "
                "ends after its last step",
                highlight=False,
            )
            options.append(f"--warn-after={max(0.0, minutes - (time.monotonic() - started_s) / 60)}")
        if episodes is not None:
            options.append(f"--episodes={episodes.value}")
        if teacher_rounds is not None:
            options.append(f"--teacher-rounds={teacher_rounds}")
        if threads:
            options.append(f"--threads={threads}")
        where = [f"--dataset={dataset}", f"--manager={cluster.address}", f"--out={folder}"]
        run_command("demo", lambda: cluster_problem(cluster), "train", *where, *options)
        _report_restarts(cluster)
    ended_s = time.monotonic()
    console.print(
        f"tasks {built_s - started_s:.0f} s, training {ended_s - built_s:.0f} s, logs in {folder / 'cluster' / 'logs'}",
        highlight=False,
    )
    task_id = _most_successful_task(folder)
    if task_id:
        # Rich would wrap a line that is meant to be copied.
        typer.echo(f"try next: embomatrix play {task_id} --policy {folder} --dataset {dataset}")


def _minutes(dataset: Path, model: str, imitation_steps: int, steps: int) -> int | None:
    """Return the typical minutes of the run on two cores, None for a model other than `tiny`."""
    from embomatrix.trainer.config.settings import EvaluationSettings
    from embomatrix.trainer.config.typical_times import evaluations_during, typical_seconds

    if model != "tiny":
        return None
    try:
        tasks = len(Dataset.load(dataset).heldout)
    except DatasetError:
        return None  # `train` says what is wrong with it
    settings = EvaluationSettings(every=EVALUATE_EVERY)
    per_task = 2 * settings.samples + settings.samples_during * evaluations_during(settings, steps)
    return math.ceil(typical_seconds(imitation_steps, steps, tasks * per_task) / 60)


def _most_successful_task(folder: Path) -> str:
    """Return the held-out task that the run's policy solves most often; "" without held-out tasks."""
    from embomatrix.trainer.logging.outcome import read_outcome

    outcome = read_outcome(folder)
    best = max(outcome.after or outcome.before, key=lambda task: task.rate or 0.0, default=None)
    return best.task_id if best is not None else ""


def _ensure_tasks(dataset: Path) -> None:
    """Unpack the shipped dataset if there is none."""
    if (dataset / TASKS_FILE).exists():
        console.print(f"tasks of {dataset}, which was there before", highlight=False)
        return
    console.rule("tasks")
    try:
        unpack(dataset)
    except (DatasetError, OSError) as error:
        fail("demo", f"the tasks can't be unpacked to {dataset}: {error}")
    tasks = Dataset.load(dataset)
    scenes = {record.task.scene_id.partition("-")[0] for record in tasks.records}
    console.print(
        f"{len(tasks.train)} training tasks and {len(tasks.heldout)} held-out tasks in {len(scenes)} scenes, which ship with "
        "the package; `embomatrix factory generate` makes others",
        highlight=False,
    )


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
            console.print(f"{name} was restarted {count} times", highlight=False)


def _folder(wanted: Path | None) -> Path:
    """Folder without a run: the wanted one, or the first free one of the default's name."""
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
        fail("demo", f"the folder {folder} can't be created ({error.strerror}): pass another --out")
    return folder


def _holds_run(folder: Path) -> bool:
    return any((folder / "checkpoints").glob("step-*"))
