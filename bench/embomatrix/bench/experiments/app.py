"""`embomatrix experiment`: the paper's experiments, each one command that can be cut short and given again."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.console import Console

from embomatrix.bench.experiments.benchmarks import PolicyStage, bench_rows, benchmark_section
from embomatrix.bench.experiments.conduct import Conductor, Venue, own_venue
from embomatrix.bench.experiments.design import (
    RELEVANCE_ARMS,
    Arm,
    Budget,
    Design,
    checked_arms,
    keep_design,
    parse_arm,
    parse_settings,
    toml_of,
)
from embomatrix.bench.experiments.findings import Run, figures_of, findings_of
from embomatrix.bench.experiments.section import add_section, learning_section
from embomatrix.cli.failure import fail
from embomatrix.cli.local_cluster import no_problem, run_command
from embomatrix.host.cores import usable_cores
from embomatrix.pages.figures import figure_to_json, shown
from embomatrix.trainer.logging.recorder import read_metrics
from embomatrix.trainer.run.errors import TrainerError
from embomatrix.trainer.run.outcome import OUTCOME, read_outcome
from embomatrix.trainer.run.starting import usual_threads
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from contextlib import AbstractContextManager

    from embomatrix.pages.figures import Figure

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="The paper's experiments: seeds, arms, figures and a section for docs/experiments.md.",
)
console = Console(highlight=False, markup=False, soft_wrap=True)
OVERLAP_ARMS: Final = (Arm("stream", {}), Arm("none", {"grpo.overlap": '"none"'}))
"""What hiding simulation behind sampling and update is worth."""

_Dataset = Annotated[Path, typer.Option(help="Folder that `embomatrix factory build` wrote.")]
_Out = Annotated[Path, typer.Option(help="Folder for all runs; the same command goes on with what is there.")]
_Seeds = Annotated[list[int] | None, typer.Option("--seed", help="A seed; repeatable. Default: 0, 1, 2.")]
_Minutes = Annotated[float, typer.Option(min=0, help="Minutes of GRPO of each arm.")]
_Imitate = Annotated[float, typer.Option(min=0, help="Seconds of imitation at most.")]
_Steps = Annotated[int | None, typer.Option(min=1, help="Steps of GRPO of each arm, in place of minutes.")]
_ImitateSteps = Annotated[int | None, typer.Option(min=1, help="Steps of imitation, in place of seconds.")]
_Patience = Annotated[
    int, typer.Option(min=0, help="Measurements without a lower loss that end imitation; 0: none do.")
]
_Model = Annotated[str, typer.Option(help="`tiny`, or a Hugging Face name or folder.")]
_Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="A setting of imitation and all arms; repeatable."),
]
_Manager = Annotated[str, typer.Option(help="HOST:PORT of a manager; else a cluster of this machine's own.")]
_Token = Annotated[str, typer.Option(help="@FILE that holds a token of the trainer role.")]
_Ca = Annotated[Path | None, typer.Option(help="The ca.pem of a manager that serves by TLS.")]
_Workers = Annotated[int, typer.Option(min=1, max=64, help="Workers of one slot in a cluster of our own.")]
_Threads = Annotated[int, typer.Option(min=0, help="Threads of torch in each process; 0: half of the cores.")]
_Json = Annotated[Path | None, typer.Option("--json", help="File for the figures.")]
_SoFar = Annotated[bool, typer.Option("--so-far", help="Train nothing: tell what the finished runs found.")]
_Page = Annotated[Path | None, typer.Option(help="Page to add the section to, such as docs/experiments.md.")]
DATASET: Final = Path("build/dataset")


@app.command()
def learning(
    dataset: _Dataset = DATASET,
    out: _Out = Path("runs/experiments/learning"),
    seeds: _Seeds = None,
    minutes: _Minutes = 10.0,
    steps: _Steps = None,
    imitate_seconds: _Imitate = 600.0,
    imitate_steps: _ImitateSteps = None,
    patience: _Patience = 3,
    model: _Model = "tiny",
    settings: _Set = None,
    manager: _Manager = "",
    token: _Token = "",
    ca: _Ca = None,
    workers: _Workers = 2,
    threads: _Threads = 0,
    so_far: _SoFar = False,
    json_file: _Json = None,
    page: _Page = None,
) -> None:
    """Learning curves with and without the reward's relevance tier, each seed's arms from one imitated policy."""
    with _problems_shown():
        name = "learning with and without the relevance reward"
        budgets = (Budget(imitate_seconds, imitate_steps), Budget(60 * minutes, steps))
        arms = RELEVANCE_ARMS
        design = _design(name, arms, dataset, model, seeds, *budgets, patience, threads, settings)
        place = None if so_far else _place(manager, token, ca, out, workers)
        _experiment(design, dataset, out, place, json_file, page)


@app.command()
def times(
    dataset: _Dataset = DATASET,
    out: _Out = Path("runs/experiments/times"),
    seeds: _Seeds = None,
    minutes: _Minutes = 3.0,
    steps: _Steps = None,
    imitate_seconds: _Imitate = 120.0,
    imitate_steps: _ImitateSteps = None,
    model: _Model = "tiny",
    settings: _Set = None,
    manager: _Manager = "",
    token: _Token = "",
    ca: _Ca = None,
    workers: _Workers = 2,
    threads: _Threads = 0,
    so_far: _SoFar = False,
    json_file: _Json = None,
    page: _Page = None,
) -> None:
    """Where training time goes, and the system's share of it, with simulation hidden and not (the paper: about 20 %)."""
    with _problems_shown():
        budgets = (Budget(imitate_seconds, imitate_steps), Budget(60 * minutes, steps))
        arms = OVERLAP_ARMS
        design = _design("training time", arms, dataset, model, seeds or [0], *budgets, 0, threads, settings)
        place = None if so_far else _place(manager, token, ca, out, workers)
        _experiment(design, dataset, out, place, json_file, page)


@app.command()
def compare(
    arm: Annotated[
        list[str],
        typer.Option(
            metavar="NAME:KEY=VALUE,...", help="Settings of an arm; NAME alone: defaults. Repeatable."
        ),
    ],
    out: _Out,
    dataset: _Dataset = DATASET,
    title: Annotated[str, typer.Option(help="Heading of the section.")] = "settings compared",
    seeds: _Seeds = None,
    minutes: _Minutes = 3.0,
    steps: _Steps = None,
    imitate_seconds: _Imitate = 300.0,
    imitate_steps: _ImitateSteps = None,
    patience: _Patience = 3,
    model: _Model = "tiny",
    settings: _Set = None,
    manager: _Manager = "",
    token: _Token = "",
    ca: _Ca = None,
    workers: _Workers = 2,
    threads: _Threads = 0,
    so_far: _SoFar = False,
    json_file: _Json = None,
    page: _Page = None,
) -> None:
    """Any settings against one another, from one imitated policy for each seed."""
    with _problems_shown():
        arms = checked_arms([parse_arm(told) for told in arm])
        budgets = (Budget(imitate_seconds, imitate_steps), Budget(60 * minutes, steps))
        design = _design(title, arms, dataset, model, seeds or [0], *budgets, patience, threads, settings)
        place = None if so_far else _place(manager, token, ca, out, workers)
        _experiment(design, dataset, out, place, json_file, page)


@app.command()
def table(
    run: Annotated[Path, typer.Option(help="Folder of a finished run of `embomatrix train`.")],
    bench: Annotated[
        list[str],
        typer.Option(help="What `embomatrix eval --bench` takes: a dataset, internal-verified, eai."),
    ],
    samples: Annotated[int, typer.Option(min=1, max=1000, help="Plans of each task.")] = 10,
    manager: _Manager = "",
    jobs: Annotated[int | None, typer.Option(min=1, help="Simulator processes without a manager.")] = None,
    json_file: _Json = None,
    page: _Page = None,
) -> None:
    """Success before and after GRPO on benchmarks, in the form of the paper's table."""
    with _problems_shown():
        stages = _stages(run)
        found = []
        for name in bench:
            for stage in stages:
                console.rule(f"{name}: {stage.label}")
                where = [f"--manager={manager}"] if manager else [f"--jobs={jobs or usable_cores()}"]
                place = stage.report(run, name).parent
                asked = (
                    f"--bench={name}",
                    f"--model={stage.policy}",
                    f"--samples={samples}",
                    f"--out={place}",
                )
                run_command("experiment", no_problem, "eval", *asked, *where)
            found.append(bench_rows(run, name, stages))
        figures = tuple(figure for rows in found for figure in rows.figures)
        _hand_in("table", figures, json_file)
        _publish(benchmark_section(run, found, _commit(), date.today()), run / "benchmarks.md", page)


def _stages(run: Path) -> tuple[PolicyStage, ...]:
    read_outcome(run)
    checkpoints = sorted((run / "checkpoints").glob("step-*"))
    if not (run / "reference").is_dir() or not checkpoints:
        raise TrainerError(
            f"{run} holds no policy before and after GRPO: expected the folder of `embomatrix train`"
        )
    return (PolicyStage("imitation", run / "reference"), PolicyStage("GRPO", checkpoints[-1]))


def _design(
    name: str,
    arms: tuple[Arm, ...],
    dataset: Path,
    model: str,
    seeds: Sequence[int] | None,
    imitation: Budget,
    grpo: Budget,
    patience: int,
    threads: int,
    settings: Sequence[str] | None,
) -> Design:
    tasks = dataset / "tasks.jsonl"
    if not tasks.is_file():
        raise TrainerError(
            f"no dataset at {dataset}: build one with `embomatrix factory build --out={dataset}`"
        )
    digest = hashlib.sha256(tasks.read_bytes()).hexdigest()[:12]
    return Design(
        name=name,
        dataset=f"`{dataset.name}` ({digest})",
        model=model,
        seeds=tuple(dict.fromkeys(seeds or (0, 1, 2))),
        imitation=imitation,
        patience=patience,
        grpo=grpo,
        threads=threads or usual_threads(),
        shared=parse_settings(settings or ()),
        arms=arms,
    )


def _place(
    manager: str, token: str, ca: Path | None, out: Path, workers: int
) -> AbstractContextManager[Venue]:
    if not manager:
        return own_venue(out, workers, slots=1)
    told = [f"--manager={manager}", *([f"--token={token}"] if token else []), *([f"--ca={ca}"] if ca else [])]
    return contextlib.nullcontext(Venue(tuple(told), no_problem))


def _experiment(
    design: Design,
    dataset: Path,
    out: Path,
    place: AbstractContextManager[Venue] | None,
    json_file: Path | None,
    page: Path | None,
) -> None:
    """Conduct what is not done yet, unless there is no ``place``; then tell what the finished runs found."""
    _check_settings(design)
    # Threads that spin while they wait would take the cores from the simulators.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    machine, commit = _machine(), _commit()
    keep_design(out, design)
    conductor = Conductor(design, dataset, out, console.rule)
    if place is not None:
        _conduct(conductor, place)
    arms = []
    for arm in design.arms:
        folders = {seed: conductor.folder_of(seed, arm.name) for seed in design.seeds}
        done = {seed: folder for seed, folder in folders.items() if (folder / OUTCOME).is_file()}
        runs = [Run(seed, arm.name, read_outcome(at), read_metrics(at)) for seed, at in done.items()]
        arms += [findings_of(arm.name, runs)] if runs else []
    if not arms:
        raise TrainerError(f"no run in {out} is finished: give the command without --so-far")
    _hand_in(design.name, figures_of(arms), json_file)
    _publish(learning_section(design, arms, machine, commit, date.today()), out / "section.md", page)


def _conduct(conductor: Conductor, place: AbstractContextManager[Venue]) -> None:
    for seed in conductor.design.seeds:
        conductor.imitate(seed)
    with place as venue:
        for seed in conductor.design.seeds:
            for arm in conductor.design.arms:
                conductor.train(seed, arm, venue)


def _check_settings(design: Design) -> None:
    """A setting that is none is refused before anything is computed. Raises TrainerError."""
    import tomllib

    from embomatrix.trainer.run.settings import checked_settings

    for arm in design.arms:
        checked_settings(tomllib.loads(toml_of({**design.shared, **arm.settings})))


def _machine() -> dict[str, object]:
    from embomatrix.bench.report.figures import describe_machine

    return describe_machine()


def _commit() -> str:
    from embomatrix.bench.report.figures import commit_here

    return commit_here()


def _hand_in(name: str, figures: Sequence[Figure], json_file: Path | None) -> None:
    for figure in figures:
        console.print(f"{figure.name:32} {shown(figure.value):>8} {figure.bound:>8} {figure.verdict}")
    if json_file is None:
        return
    value = {
        "bench": f"experiment {name}",
        "commit": _commit(),
        "machine": _machine(),
        "figures": [figure_to_json(figure) for figure in figures],
    }
    json_file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(json_file, (json.dumps(value, indent=2) + "\n").encode("utf-8"))


def _publish(section: str, own: Path, page: Path | None) -> None:
    write_whole(own, section.encode("utf-8"))
    if page is not None:
        add_section(page, section)
    console.print(f"section     {own}" + (f", added to {page}" if page else ""))


@contextlib.contextmanager
def _problems_shown() -> Iterator[None]:
    try:
        yield
    except TrainerError as error:
        fail("experiment", str(error))
