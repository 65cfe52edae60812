"""`embomatrix bench`: measure this machine, print the figures, write them as JSON and render the page of benchmarks."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from embomatrix.bench.adversary.siege import QUICK_SIEGE, SiegeSizes, bench_adversary
from embomatrix.bench.cluster.ablation import AblationSizes, bench_ablation
from embomatrix.bench.cluster.flow import FlowSizes, bench_flow
from embomatrix.bench.cluster.prewarm import PrewarmSizes, bench_prewarm
from embomatrix.bench.engine.engine import bench_engine
from embomatrix.bench.engine.plan_writer import save_workload, write_workload
from embomatrix.bench.engine.workload import PINNED, SIZES, WORKLOAD_FILE, Workload, load_workload
from embomatrix.bench.fidelity.page import figures_of
from embomatrix.bench.fidelity.pool import Modes
from embomatrix.bench.fidelity.suite import DISAGREEMENTS_FILE, RESULTS_FILE, FidelitySettings, run_fidelity
from embomatrix.bench.peers.contest import PeerSizes, bench_peers
from embomatrix.bench.report.figures import (
    RESULT_MARK,
    BenchError,
    BenchResult,
    describe_machine,
    merge_parts,
    read_result,
)
from embomatrix.bench.report.output import console, errors, hand_in, refusals, write
from embomatrix.bench.report.page import check_page, render_page
from embomatrix.host.code_version import commit_here
from embomatrix.host.commands import command_group
from embomatrix.host.own_files import Force, keep_foreign, prepare_output
from embomatrix.pages.figures import Figure
from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.simulation import load_simulator
from embomatrix.starter.options import DATASET_VARIABLE, DEFAULT_DATASET, DatasetFolder, default_dataset
from embomatrix.world.dataset import TASKS_FILE, Dataset

OnStep = Callable[[str], None]

app = command_group(help="Measure the engine, the cluster, the trainer and operations on this machine.")


class ClusterPart(StrEnum):
    """Parts of the cluster's benchmark, in the order of the page."""

    ABLATION = "ablation"
    FLOW = "flow"
    PREWARM = "prewarm"
    PEERS = "peers"


PINNED_HELP = (
    "Folder of a dataset with the plans of `bench workload`. Default: the small one that the package ships, so that "
    "figures can be compared."
)
DataSet = Annotated[Path, typer.Option("--dataset", help=PINNED_HELP, show_default=False)]
Json = Annotated[Path | None, typer.Option("--json", help="File for the figures.")]
PageFile = Annotated[Path, typer.Option(help="Page to update; text between its tables is kept.")]
Cycles = Annotated[int, typer.Option(min=80, help="Cycles of loading and resetting that show memory growth.")]
LimitS = Annotated[
    float, typer.Option(min=5.0, help="Seconds for one cluster, from its first process to its last result.")
]
Parts = Annotated[
    list[ClusterPart] | None, typer.Option("--part", help="Part to measure; repeatable. [default: all]")
]
Naive = Annotated[int, typer.Option(min=1, help="Rollouts of the ablation's first row; each takes seconds.")]
PAGE = Path("docs/benchmarks.md")
ALL: Final = ("engine", "cluster")
"""Benchmarks of `bench all`."""
FULL_SUITE = Path("build/scenes")
MODES = Modes(cached=load_simulator, physical=physical_simulator)
QUICK = FidelitySettings(plans=24, calls=0, seed=0)


@app.command()
def engine(dataset: DataSet = PINNED, json_file: Json = None, cycles: Cycles = 2000) -> None:
    """Measure loading, executing and resetting on one core."""
    with refusals(json_file):
        hand_in(_engine(load_workload(dataset), cycles), json_file)


@app.command()
def cluster(
    dataset: DataSet = PINNED,
    json_file: Json = None,
    part: Parts = None,
    naive: Naive = 16,
    limit_s: LimitS = 120.0,
) -> None:
    """Measure the paper's ablation, the manager under load, look-ahead, and other libraries on the same work."""
    with refusals(json_file):
        hand_in(_cluster(load_workload(dataset), part, naive, limit_s), json_file)


@app.command()
def simulation(
    json_file: Json = None,
    most_workers: Annotated[
        int, typer.Option(min=10, max=100_000, help="Workers of the largest simulated cluster.")
    ] = 10_000,
) -> None:
    """Measure the manager's decisions in simulated clusters; needs no dataset and starts no process."""
    from embomatrix.bench.cluster.simulated import SimulationBench

    def measure(on_step: OnStep) -> Sequence[Figure]:
        return list(SimulationBench(on_step).figures(most_workers))

    with refusals(json_file):
        hand_in(_measured("simulation", measure, most_workers=most_workers), json_file)


@app.command()
def trainer(
    dataset: DataSet = PINNED,
    json_file: Json = None,
    trl: Annotated[
        Path | None,
        typer.Option(
            help="Python of an environment with TRL, to compare with: `python3.11 -m venv trl && trl/bin/pip install "
            "trl==1.16.0`.",
            envvar="EMBOMATRIX_TRL",
        ),
    ] = None,
    gpu: Annotated[
        bool,
        typer.Option(
            "--gpu",
            help="Measure full fine-tuning of a random model of 1.5 billion weights on a GPU instead.",
        ),
    ] = False,
) -> None:
    """Measure a GRPO step, the time shares of a short run, and an evaluation of stored answers."""
    from embomatrix.bench.trainer.measure import bench_gpu_trainer, bench_trainer

    bench = bench_gpu_trainer if gpu else bench_trainer
    with refusals(json_file):
        hand_in(_measured("trainer", lambda on_step: bench(dataset, trl, on_step)), json_file)


@app.command()
def operations(
    dataset: DataSet = PINNED,
    json_file: Json = None,
) -> None:
    """Measure image sizes, `docker compose up` to its first rollout, joining, and the dashboard.

    Parts that need Docker or Chromium are left out with a note if these are missing.
    """
    with refusals(json_file):
        workload = load_workload(dataset)
        hand_in(_measured("operations", lambda on_step: _operations(workload, on_step)), json_file)


@app.command("first-hour")
def first_hour(
    json_file: Json = None,
    seeds: Annotated[
        int,
        typer.Option(
            min=0,
            help="Seeds of `make run`, each with GRPO and with imitation that goes on for as long. 0: none.",
        ),
    ] = 1,
    first: Annotated[int, typer.Option(min=0, help="The first seed; the others follow it.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the runs; finished ones are kept.")] = Path(
        "build/first_hour"
    ),
    record: Annotated[
        Path | None,
        typer.Option(
            help="File for the seeds, which join those in it; the figures are about all of them. "
            "Default: the seeds are held against the recorded ones."
        ),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Steps of GRPO, if not those of `make run`.")
    ] = None,
    imitate_steps: Annotated[
        int | None, typer.Option(min=1, help="Steps of imitation before GRPO, if not those of `make run`.")
    ] = None,
) -> None:
    """Measure what a newcomer meets: the gain of `make run`, the wheel's first plan, and the trainer's image.

    A seed takes about half an hour on two cores.
    """
    from embomatrix.bench.first_hour.record import add_to_record, comparison, figures_of, read_record
    from embomatrix.bench.first_hour.seeds import run_seed
    from embomatrix.bench.first_hour.wheel import measure_wheel

    given = {"steps": steps, "imitate-steps": imitate_steps}
    budget = {name: value for name, value in given.items() if value is not None}
    known = {run.seed: run for run in read_record()}
    notes: list[str] = []

    def measure(on_step: OnStep) -> Sequence[Figure]:
        runs = [run_seed(seed, out, budget, on_step) for seed in range(first, first + seeds)]
        notes.extend(comparison(known[run.seed], run) for run in runs if run.seed in known and not budget)
        told = runs if record is None else add_to_record(record, runs)
        figures = list(figures_of(told)) if told else []
        if Path("pyproject.toml").exists():
            figures.append(measure_wheel(Path(), on_step))
        else:
            _note("wheel_first_plan_s is left out: it needs the checkout as working folder")
        return [*figures, *_trainer_image()]

    with refusals(json_file, record):
        hand_in(_measured("first-hour", measure), json_file)
        for note in notes:
            console.print(note, highlight=False)


def _trainer_image() -> list[Figure]:
    """Return the size of the trainer's image; none with a note if it is not built."""
    from embomatrix.bench.operations.compose import compose_at, image_sizes

    sizes = image_sizes() if compose_at(Path()) else ()
    found = [figure for figure in sizes if figure.name == "image_trainer_mb"]
    if not found:
        _note(
            "image_trainer_mb is left out: it needs a Docker engine, the checkout, "
            "and `docker compose --profile trainer build`"
        )
    return found


@app.command()
def pictures(json_file: Json = None) -> None:
    """Measure the CPU time of pictures of base scenes; needs no dataset."""
    from embomatrix.bench.pictures.renders import bench_renders

    with refusals(json_file):
        hand_in(_measured("pictures", bench_renders), json_file)


@app.command()
def traffic(
    record: Annotated[
        Path | None,
        typer.Option(
            help="Traffic of your own run: a file of `embomatrix train --record`. [default: a shipped sample]"
        ),
    ] = None,
    dataset: Annotated[
        Path | None,
        typer.Option(
            help=f"Folder of that run's dataset. Default: ${DATASET_VARIABLE}, or {DEFAULT_DATASET}.",
            show_default=False,
        ),
    ] = None,
    json_file: Json = None,
    rounds: Annotated[int, typer.Option(min=1, help="Replays of each phase.")] = 3,
) -> None:
    """Replay what a training run submitted, with and without shared calls, and through other libraries; play episodes."""
    from embomatrix.bench.traffic.marks import bench_marks
    from embomatrix.bench.traffic.recording import recorded_traffic, sampled_traffic
    from embomatrix.bench.traffic.replay import TrafficSizes, bench_traffic
    from embomatrix.bench.traffic.turns import TurnSizes, bench_turns

    def measure(on_step: OnStep) -> Sequence[Figure]:
        on_step("returns to earlier states")
        marks = bench_marks(pinned)
        return (*bench_traffic(found, sizes, on_step), *marks, *bench_turns(pinned, TurnSizes(), on_step))

    if record is None and dataset is not None:
        raise typer.BadParameter(
            "--dataset is the dataset of a --record: give both, or neither for the shipped sample"
        )
    with refusals(json_file):
        found = (
            sampled_traffic() if record is None else recorded_traffic(record, dataset or default_dataset())
        )
        pinned, sizes = load_workload(PINNED), TrafficSizes(rounds=rounds)
        hand_in(_measured("traffic", measure), json_file)


@app.command()
def sample(
    record: Annotated[Path, typer.Option(help="File of `embomatrix train --record`.")],
    out: Annotated[Path, typer.Option(help="Folder to write to.")],
    dataset: DatasetFolder = DEFAULT_DATASET,
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of the sample.")] = 18,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds and records give equal samples.")] = 0,
    force: Force = False,
) -> None:
    """Write a sample of a training run's traffic, as the package ships one for `bench traffic`."""
    from embomatrix.bench.traffic.recording import GROUPS_FILE, SCENES_FILE, save_sample

    keep_foreign("bench", [out / GROUPS_FILE, out / SCENES_FILE], force=force)
    with refusals():
        found = save_sample(record, dataset, out, scenes, seed)
    groups = f"{len(found.early)} early and {len(found.late)} late groups"
    console.print(f"wrote {groups} in {len(found.bundles)} scenes to {out}", highlight=False)


@app.command()
def adversary(
    dataset: DataSet = PINNED,
    json_file: Json = None,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds draw equal messages.")] = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help=f"Send {QUICK_SIEGE.messages:,} messages: a check, not a result.")
    ] = False,
) -> None:
    """Attack a manager with hostile workers, trainers and clients, and goals with plans; measure the harm."""
    from embomatrix.bench.adversary.shortcuts import QUICK_HUNT, HuntSizes, hunt_shortcuts

    siege = replace(QUICK_SIEGE if quick else SiegeSizes(), seed=seed)
    hunt = replace(QUICK_HUNT if quick else HuntSizes(), seed=seed)

    def measure(on_step: OnStep) -> Sequence[Figure]:
        return (*bench_adversary(found, siege, on_step), *hunt_shortcuts(hunt, on_step))

    with refusals(json_file):
        found = load_workload(dataset)
        hand_in(_measured("adversary", measure), json_file)


@app.command()
def fidelity(
    dataset: Annotated[
        Path | None,
        typer.Option(
            help=f"Folder of the dataset. Default: {FULL_SUITE}; with --quick the one that the package ships."
        ),
    ] = None,
    json_file: Json = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for plans, results and disagreements. [default: build/fidelity]"),
    ] = None,
    jobs: Annotated[int, typer.Option(min=0, max=64, help="Processes; 0 sums up the results so far.")] = 2,
    plans: Annotated[int, typer.Option(min=1, help="Plans at least.")] = 1_000,
    calls: Annotated[int, typer.Option(min=0, help="Calls of every skill at least.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds and datasets give equal plans.")] = 0,
    quick: Annotated[
        bool,
        typer.Option("--quick", help=f"Run {QUICK.plans} plans: a check that takes minutes, not a result."),
    ] = False,
) -> None:
    """Run the same plans in cached and in physical mode and compare; resumes an interrupted suite."""
    with refusals(json_file):
        found = Dataset.load(dataset or (PINNED if quick else FULL_SUITE))
        if quick and (plans, calls) != (1_000, 200):
            raise BenchError("--quick has its own numbers of plans and calls: leave out --plans and --calls")
        settings = replace(QUICK, seed=seed) if quick else FidelitySettings(plans, calls, seed)
        folder = out or Path("build/fidelity-quick" if quick else "build/fidelity")
        hand_in(_fidelity(found, settings, folder, jobs), json_file)


@app.command()
def workload(
    dataset: DatasetFolder = DEFAULT_DATASET,
    out: Annotated[Path | None, typer.Option(help="Folder to write to. [default: the dataset's]")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds and datasets give equal files.")] = 0,
    bodies: Annotated[
        int, typer.Option(help=f"Main size of scenes: one of {', '.join(map(str, SIZES))}.")
    ] = 300,
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of the main size.")] = 4,
    plans: Annotated[int, typer.Option(min=1, help="Plans for each scene, all different.")] = 50,
    force: Force = False,
) -> None:
    """Write the plans that benchmarks execute in a dataset's scenes."""
    if bodies not in SIZES:
        raise typer.BadParameter(f"found {bodies}: expected one of {', '.join(map(str, SIZES))}")
    if out is not None and out.resolve() != dataset.resolve():
        keep_foreign("bench", [out / TASKS_FILE, out / WORKLOAD_FILE], force=force)
    with refusals(), errors.status("reading the dataset") as status:
        found = Dataset.load(dataset)

        def on_scene(scene_id: str) -> None:
            status.update(f"writing plans for {scene_id}")

        written = write_workload(
            found, seed=seed, bodies=bodies, scenes=scenes, plans=plans, on_scene=on_scene
        )
        save_workload(found, written, out or dataset)
    count = len(written.rollouts)
    console.print(f"wrote {count} plans in {len(written.scenes)} scenes to {out or dataset}", highlight=False)


@app.command(name="all")
def everything(
    dataset: DataSet = PINNED,
    out: PageFile = PAGE,
    json_dir: Annotated[Path | None, typer.Option(help="Folder for one JSON file of each benchmark.")] = None,
    limit_s: LimitS = 120.0,
    part: Parts = None,
    naive: Naive = 16,
    cycles: Cycles = 2000,
    force: Force = False,
) -> None:
    """Measure engine and cluster, and render the page."""
    with refusals():
        # A page that can't be updated is refused before minutes are spent.
        check_page(_text_of(out))
        if json_dir is not None:
            keep_foreign("bench", [json_dir / f"{name}.json" for name in ALL], RESULT_MARK, force=force)
            prepare_output("bench", *(json_dir / f"{name}.json" for name in ALL))
        prepare_output("bench", out)
        found = load_workload(dataset)
        results = [_engine(found, cycles), _cluster(found, part, naive, limit_s)]
        for result in results:
            hand_in(result, json_dir / f"{result.bench}.json" if json_dir is not None else None)
        write(out, render_page(results, _text_of(out)))
        console.print(f"wrote {out}", highlight=False)


@app.command()
def page(
    files: Annotated[list[Path], typer.Argument(help="Files that benchmarks wrote with --json.")],
    out: PageFile = PAGE,
) -> None:
    """Render the page from figures that were measured before."""
    with refusals(out):
        results = merge_parts([read_result(file) for file in files])
        write(out, render_page(results, _text_of(out)))
        console.print(f"wrote {out}", highlight=False)


def _measured(bench: str, measure: Callable[[OnStep], Sequence[Figure]], **machine: Any) -> BenchResult:
    """Measure with progress on the terminal."""
    found = describe_machine() | machine
    with errors.status(bench) as status:
        figures = measure(lambda step: status.update(f"{bench}: {step}"))
    return BenchResult(bench, commit_here(), found, tuple(figures))


def _engine(found: Workload, cycles: int) -> BenchResult:
    return _measured("engine", lambda on_step: bench_engine(found, cycles, on_step))


def _cluster(found: Workload, parts: list[ClusterPart] | None, naive: int, limit_s: float) -> BenchResult:
    def measure(on_step: OnStep) -> list[Figure]:
        measures: dict[ClusterPart, Callable[[], Sequence[Figure]]] = {
            ClusterPart.ABLATION: lambda: bench_ablation(
                found.main, AblationSizes(naive=naive, limit_s=limit_s), on_step
            ),
            ClusterPart.FLOW: lambda: bench_flow(found.main, FlowSizes(limit_s=limit_s), on_step),
            ClusterPart.PREWARM: lambda: bench_prewarm(found, PrewarmSizes(limit_s=limit_s), on_step),
            ClusterPart.PEERS: lambda: bench_peers(found.main, PeerSizes(), on_step),
        }
        return [
            figure for part in ClusterPart if part in (parts or ClusterPart) for figure in measures[part]()
        ]

    return _measured("cluster", measure)


def _operations(found: Workload, on_step: OnStep) -> list[Figure]:
    from embomatrix.bench.operations.compose import (
        compose_at,
        image_sizes,
        measure_first_rollout,
        missing_images,
    )
    from embomatrix.bench.operations.dashboard import browser_path, measure_dashboard
    from embomatrix.bench.operations.joining import measure_joining

    figures: list[Figure] = []
    compose = compose_at(Path())
    if compose is None:
        _note("images and compose are left out: they need a Docker engine and the checkout as working folder")
    elif missing := missing_images():
        _note(f"images and compose are left out: build {' and '.join(missing)} with `docker compose build`")
    else:
        figures += [*image_sizes(), *measure_first_rollout(compose, found, on_step)]
    if browser_path() is None:
        _note("dashboard_paint_s is left out: it needs Chromium and `pip install 'embomatrix[bench]'`")
    return [*figures, *measure_joining(on_step), *measure_dashboard(on_step)]


def _fidelity(dataset: Dataset, settings: FidelitySettings, out: Path, jobs: int) -> BenchResult:
    started_s = time.monotonic()
    fresh = not (out / RESULTS_FILE).exists()

    def measure(on_step: OnStep) -> tuple[Figure, ...]:
        outcome = run_fidelity(dataset, settings, out, jobs, MODES, on_step)
        for sentence in outcome.lost:
            _note(f"lost: {sentence}")
        return figures_of(outcome, (time.monotonic() - started_s) / 60 if fresh else None)

    result = _measured("fidelity", measure, jobs=jobs, plans_asked=settings.plans, seed=settings.seed)
    console.print(f"disagreements: {out / DISAGREEMENTS_FILE}", highlight=False)
    return result


def _note(text: str) -> None:
    errors.print(text, highlight=False, markup=False)


def _text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8") if page.exists() else ""
