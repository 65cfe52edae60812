"""`embomatrix experiment`: the paper's experiments. Each is one command; repeating it resumes its runs."""

import contextlib
import os
import tomllib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

from embomatrix.bench.experiments.benchmarks import PolicyStage, bench_table, benchmark_section
from embomatrix.bench.experiments.conduct import Conductor, Venue, own_venue
from embomatrix.bench.experiments.design import (
    RELEVANCE_ARMS,
    SECTION_FILE,
    Arm,
    Budget,
    Design,
    checked_arms,
    dataset_digest,
    keep_design,
    parse_arm,
    parse_settings,
    toml_of,
)
from embomatrix.bench.experiments.findings import figures_of, findings_of, read_runs
from embomatrix.bench.experiments.section import add_section, learning_section
from embomatrix.bench.report.figures import BenchError, BenchResult, describe_machine
from embomatrix.bench.report.output import hand_in, write
from embomatrix.cli.local_cluster import no_problem, run_command
from embomatrix.host.code_version import commit_here
from embomatrix.host.commands import command_group
from embomatrix.host.failure import fail
from embomatrix.host.limits import usable_cores
from embomatrix.host.own_files import prepare_output
from embomatrix.pages.figures import Figure
from embomatrix.starter.options import DEFAULT_DATASET, DatasetFolder
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import checked_settings
from embomatrix.trainer.logging.outcome import read_outcome
from embomatrix.trainer.run.starting import default_threads

app = command_group(
    help="Run the paper's experiments over several seeds: figures, and a section for docs/experiments/training.md."
)
console = Console(highlight=False, markup=False, soft_wrap=True)


@dataclass(frozen=True, slots=True)
class Preset:
    """Defaults of one experiment. Arms that are not preset must be given."""

    title: str
    out: Path | None = None
    arms: tuple[Arm, ...] = ()
    seeds: tuple[int, ...] = (0,)
    minutes: float = 3.0
    imitate_seconds: float = 300.0
    patience: int = 3


RUNS: Final = Path("runs/experiments")
LEARNING: Final = Preset(
    "learning with and without the relevance reward",
    RUNS / "learning",
    RELEVANCE_ARMS,
    seeds=(0, 1, 2),
    minutes=10.0,
    imitate_seconds=600.0,
)
TIMES: Final = Preset(
    "training time",
    RUNS / "times",
    (Arm("stream", {}), Arm("none", {"grpo.overlap": '"none"'})),
    imitate_seconds=120.0,
    patience=0,
)
COMPARE: Final = Preset("settings compared")

_Json = Annotated[Path | None, typer.Option("--json", help="File for the figures.")]
_Page = Annotated[
    Path | None, typer.Option(help="Page to append the section to, such as docs/experiments/training.md.")
]
_Manager = Annotated[str, typer.Option(help="HOST:PORT of a manager; by default a cluster on this machine.")]
_Arm = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME:KEY=VALUE,...", help="Settings of an arm; NAME alone: defaults. Repeatable."),
]
_Out = Annotated[Path | None, typer.Option(help="Folder of all runs; the same command resumes them.")]
_Title = Annotated[str, typer.Option(help="Heading of the section.")]
_Seeds = Annotated[
    list[int] | None,
    typer.Option("--seed", help="A seed; repeatable. [default: 0, 1, 2 of learning, else 0]"),
]
_Minutes = Annotated[float, typer.Option(min=0, help="Minutes of GRPO of each arm.")]
_Steps = Annotated[int | None, typer.Option(min=1, help="Steps of GRPO of each arm, instead of minutes.")]
_Imitate = Annotated[float, typer.Option(min=0, help="Seconds of imitation at most.")]
_ImitateSteps = Annotated[int | None, typer.Option(min=1, help="Steps of imitation, instead of seconds.")]
_Patience = Annotated[
    int, typer.Option(min=0, help="Measurements without a lower loss that end imitation early; 0: never.")
]
_Model = Annotated[str, typer.Option(help="`tiny`, or a Hugging Face name or folder.")]
_Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="A setting of imitation and all arms; repeatable."),
]
_Token = Annotated[str, typer.Option(help="@FILE with a token of the trainer role.")]
_Ca = Annotated[Path | None, typer.Option(help="The ca.pem of a manager that serves by TLS.")]
_Workers = Annotated[
    int, typer.Option(min=1, max=64, help="Workers of one slot in a cluster on this machine.")
]
_Threads = Annotated[int, typer.Option(min=0, help="Threads of torch in each process; 0: half of the cores.")]
_SoFar = Annotated[bool, typer.Option("--so-far", help="Train nothing and report the finished runs.")]


def _experiment(preset: Preset, summary: str) -> Callable[..., None]:
    """Make the command of an experiment: all experiments have the same options with other defaults."""

    def command(
        arm: _Arm = None,
        out: _Out = preset.out,
        dataset: DatasetFolder = DEFAULT_DATASET,
        title: _Title = preset.title,
        seeds: _Seeds = None,
        minutes: _Minutes = preset.minutes,
        steps: _Steps = None,
        imitate_seconds: _Imitate = preset.imitate_seconds,
        imitate_steps: _ImitateSteps = None,
        patience: _Patience = preset.patience,
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
        with _refusals(json_file, page):
            arms = checked_arms([parse_arm(text) for text in arm]) if arm else preset.arms
            if out is None or not arms:
                raise TrainerError("an experiment needs a folder and arms: name them with --out and --arm")
            design = Design(
                name=title,
                dataset=f"`{dataset.name}` ({dataset_digest(dataset)})",
                model=model,
                seeds=tuple(dict.fromkeys(seeds or preset.seeds)),
                imitation=Budget(imitate_seconds, imitate_steps),
                patience=patience,
                grpo=Budget(60 * minutes, steps),
                threads=threads or default_threads(),
                shared=parse_settings(settings or ()),
                arms=arms,
            )
            venue = None if so_far else _venue(manager, token, ca, out, workers)
            _conduct(design, dataset, out, venue, json_file, page)

    command.__doc__ = summary
    return command


app.command("learning")(
    _experiment(
        LEARNING, "Learning curves with and without the reward's relevance tier, from one imitated policy."
    )
)
app.command("times")(
    _experiment(TIMES, "Time shares of training with simulation overlapped and not (the paper: about 20 %).")
)
app.command("compare")(_experiment(COMPARE, "Any settings against one another, from one imitated policy."))


@app.command()
def table(
    run: Annotated[Path, typer.Option(help="Folder of a finished run of `embomatrix train`.")],
    bench: Annotated[
        list[str],
        typer.Option(help="Benchmark of `embomatrix eval --bench`: a dataset, internal-verified-2, eai."),
    ],
    samples: Annotated[int, typer.Option(min=1, max=1000, help="Plans of each task.")] = 10,
    manager: _Manager = "",
    token: _Token = "",
    ca: _Ca = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Simulator processes without a manager.")] = None,
    json_file: _Json = None,
    page: _Page = None,
) -> None:
    """Success before and after GRPO on benchmarks, as in the paper's table."""
    with _refusals(json_file, page):
        stages = _stages(run)
        machine, commit = describe_machine(), commit_here()
        lines: list[str] = []
        figures: list[Figure] = []
        where = _connection(manager, token, ca) or (f"--jobs={jobs or usable_cores()}",)
        for name in bench:
            for stage in stages:
                console.rule(f"{name}: {stage.label}")
                out = stage.report(run, name).parent
                options = (
                    f"--bench={name}",
                    f"--model={stage.policy}",
                    f"--samples={samples}",
                    f"--out={out}",
                )
                run_command("experiment", no_problem, "eval", *options, *where)
            table_lines, success = bench_table(run, name, stages)
            lines += table_lines
            figures += success
        hand_in(BenchResult("experiment table", commit, machine, tuple(figures)), json_file)
        _publish(benchmark_section(run, lines, commit, date.today()), run / "benchmarks.md", page)


def _stages(run: Path) -> tuple[PolicyStage, ...]:
    read_outcome(run)
    checkpoints = sorted((run / "checkpoints").glob("step-*"))
    if not (run / "reference").is_dir() or not checkpoints:
        raise TrainerError(
            f"{run} holds no policy before and after GRPO: expected the folder of `embomatrix train`"
        )
    return (PolicyStage("imitation", run / "reference"), PolicyStage("GRPO", checkpoints[-1]))


def _venue(
    manager: str, token: str, ca: Path | None, out: Path, workers: int
) -> AbstractContextManager[Venue]:
    if not manager:
        return own_venue(out, workers, slots=1)
    return contextlib.nullcontext(Venue(_connection(manager, token, ca), no_problem))


def _connection(manager: str, token: str, ca: Path | None) -> tuple[str, ...]:
    """Return the options that name a manager; none without one."""
    options = {"manager": manager, "token": token, "ca": ca} if manager else {}
    return tuple(f"--{name}={value}" for name, value in options.items() if value)


def _conduct(
    design: Design,
    dataset: Path,
    out: Path,
    venue: AbstractContextManager[Venue] | None,
    json_file: Path | None,
    page: Path | None,
) -> None:
    """Run everything that is not finished, unless there is no ``venue``; then report the finished runs."""
    for arm in design.arms:
        # A wrong setting is refused before anything is computed.
        checked_settings(tomllib.loads(toml_of({**design.shared, **arm.settings})))
    # Threads that spin while they wait would take the cores from the simulators.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    machine, commit = describe_machine(), commit_here()
    keep_design(out, design)
    conductor = Conductor(design, dataset, out, console.rule)
    if venue is not None:
        conductor.conduct(venue)
    runs = read_runs(design, conductor.folder_of)
    arms = [findings_of(name, of_arm) for name, of_arm in runs.items() if of_arm]
    if not arms:
        raise TrainerError(f"no run in {out} is finished: give the command without --so-far")
    hand_in(BenchResult(f"experiment {design.name}", commit, machine, figures_of(arms)), json_file)
    _publish(learning_section(design, arms, machine, commit, date.today()), out / SECTION_FILE, page)


def _publish(section: str, own: Path, page: Path | None) -> None:
    write(own, section)
    if page is not None:
        add_section(page, section)
    console.print(f"section     {own}" + (f", added to {page}" if page else ""))


@contextlib.contextmanager
def _refusals(*outputs: Path | None) -> Iterator[None]:
    prepare_output("experiment", *outputs)
    try:
        yield
    except (BenchError, TrainerError) as error:
        fail("experiment", str(error))
