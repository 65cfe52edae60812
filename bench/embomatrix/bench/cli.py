"""`embomatrix bench`: measure this machine, write figures as JSON, show them as a table, render the page."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from embomatrix.bench.cluster.cli import (
    DATASET,
    ENGINE_DATASET,
    LIMIT_S,
    NAIVE,
    DataSet,
    EngineDataSet,
    Json,
    LimitS,
    Naive,
    Parts,
    Work,
    cluster,
    cluster_job,
    measure_cluster,
)
from embomatrix.bench.cluster.overhead import ClusterLoad
from embomatrix.bench.engine.engine import bench_engine, check_scenes
from embomatrix.bench.engine.rollout import bench_rollout
from embomatrix.bench.engine.scenes import scenes_of
from embomatrix.bench.engine.workload import PINNED, SIZES, read_workload, workload_to_text, write_workload
from embomatrix.bench.fidelity.page import figures_of, read_disagreement, skill_table
from embomatrix.bench.fidelity.page import replay as replayed
from embomatrix.bench.fidelity.pool import Modes
from embomatrix.bench.fidelity.suite import (
    DISAGREEMENTS_FILE,
    RESULTS_FILE,
    FidelitySettings,
    SuiteProgress,
    run_fidelity,
)
from embomatrix.bench.operations.cli import operations
from embomatrix.bench.report.figures import (
    BenchResult,
    commit_here,
    describe_machine,
    figure_in,
    put_together,
    read_result,
)
from embomatrix.bench.report.output import console, errors, hand_in, refusals, write
from embomatrix.bench.report.page import hand_parts, render_page
from embomatrix.bench.trainer.cli import trainer
from embomatrix.sim.fidelity.report import report_on
from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.dataset import Dataset

if TYPE_CHECKING:
    from collections.abc import Sequence

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Measure the engine, rollouts and the cluster on this machine.",
)
Scenes = Annotated[int, typer.Option(min=1, help="Scenes to measure in.")]
Repeats = Annotated[int, typer.Option(min=1, help="Executions of each plan.")]
Page = Annotated[Path, typer.Option(help="Page to write; parts written by hand are kept.")]
Cycles = Annotated[int, typer.Option(min=80, help="Cycles of loading and resetting, to see growth.")]

FIDELITY_DATASET = Path("build/scenes")
FIDELITY_OUT = Path("build/fidelity")
PAGE = Path("docs/benchmarks.md")
SPEEDUP = "skill_speedup_min"
MODES = Modes(cached=load_simulator, physical=physical_simulator)

app.command()(cluster)
app.command()(operations)
app.command()(trainer)


@app.command()
def rollout(
    dataset: DataSet = DATASET, json_file: Json = None, scenes: Scenes = 24, repeats: Repeats = 3
) -> None:
    """Measure loading, skills, rollouts, reset and reward in one process."""
    with refusals():
        hand_in(_rollout(dataset, scenes, repeats), json_file)


@app.command()
def engine(
    dataset: DataSet = ENGINE_DATASET,
    workload: Work = PINNED,
    json_file: Json = None,
    cycles: Cycles = 2000,
    fidelity: Annotated[
        Path | None,
        typer.Option(help="Figures that `bench fidelity` wrote: skill_speedup_min is taken from there."),
    ] = None,
) -> None:
    """Measure the engine on one core with a pinned workload in furnished scenes."""
    with refusals():
        speedup = (figure_in(fidelity, SPEEDUP),) if fidelity is not None else ()
        result = _engine(dataset, workload, cycles)
        hand_in(replace(result, figures=(*result.figures, *speedup)), json_file)


@app.command()
def fidelity(
    dataset: DataSet = FIDELITY_DATASET,
    json_file: Json = None,
    out: Annotated[Path, typer.Option(help="Folder for plans, results and disagreements.")] = FIDELITY_OUT,
    jobs: Annotated[
        int, typer.Option(min=0, max=64, help="Processes; with 0 the results so far are summed up.")
    ] = 2,
    plans: Annotated[int, typer.Option(min=1, help="Plans at least.")] = 1_000,
    calls: Annotated[int, typer.Option(min=0, help="Calls of every skill at least.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds and datasets give equal plans.")] = 0,
    replay: Annotated[
        str, typer.Option(help="FILE:N, a line of the disagreements, to see step by step.")
    ] = "",
) -> None:
    """Run the same plans in both execution modes and tell how far they agree; goes on where it was cut short."""
    with refusals():
        if replay:
            for line in replayed(Dataset.load(dataset), read_disagreement(replay), MODES):
                console.print(line, highlight=False, markup=False, soft_wrap=True)
            return
        settings = FidelitySettings(plans, calls, seed)
        hand_in(_fidelity(Dataset.load(dataset), settings, out, jobs), json_file)


@app.command()
def workload(
    dataset: DataSet = ENGINE_DATASET,
    out: Annotated[Path, typer.Option(help="File to write.")] = PINNED,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds and datasets give equal files.")] = 0,
    bodies: Annotated[
        int, typer.Option(help=f"Main size of scenes: one of {', '.join(map(str, SIZES))}.")
    ] = 300,
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of the main size.")] = 8,
    plans: Annotated[int, typer.Option(min=1, help="Plans for each scene, all different.")] = 50,
) -> None:
    """Write the plans that `bench engine` executes: after a change of scenes, their digests are no longer the same."""
    if bodies not in SIZES:
        raise typer.BadParameter(f"found {bodies}: expected one of {', '.join(map(str, SIZES))}")
    with refusals(), errors.status("reading the dataset") as status:
        written = write_workload(
            Dataset.load(dataset),
            seed=seed,
            bodies=bodies,
            scenes=scenes,
            plans=plans,
            on_scene=lambda scene_id: status.update(f"writing plans for {scene_id}"),
        )
        write(out, workload_to_text(written))
    count = sum(len(scene.executions) for scene in written.scenes)
    console.print(f"wrote {count} plans in {len(written.scenes)} scenes to {out}", highlight=False)


@app.command(name="all")
def everything(
    dataset: DataSet = DATASET,
    out: Page = PAGE,
    json_dir: Annotated[Path | None, typer.Option(help="Folder for one JSON file for each bench.")] = None,
    limit_s: LimitS = LIMIT_S,
    part: Parts = None,
    naive: Naive = NAIVE,
    engine_dataset: EngineDataSet = ENGINE_DATASET,
    workload: Work = PINNED,
    cycles: Cycles = 2000,
    fidelity: Annotated[
        Path | None, typer.Option(help="Figures that `bench fidelity` wrote, to go on the page.")
    ] = None,
) -> None:
    """Run every bench but that of fidelity, which takes its time, and render the page."""
    with refusals():
        # What can't be read or replaced is refused before minutes are spent.
        hand_parts(_present(out))
        check_scenes(Dataset.load(engine_dataset), read_workload(workload))
        job = cluster_job(dataset, engine_dataset, workload, part, naive, ClusterLoad(limit_s=limit_s))
        agreement = [read_result(fidelity)] if fidelity is not None else []
        results = [
            _engine(engine_dataset, workload, cycles),
            _rollout(dataset, scenes=24, repeats=3),
            measure_cluster(job),
        ]
        results = _with_speedup([*results, *agreement])
        for result in results:
            hand_in(result, json_dir / f"{result.bench}.json" if json_dir is not None else None)
        write(out, render_page(results, _present(out)))
        console.print(f"wrote {out}", highlight=False)


@app.command()
def page(
    files: Annotated[list[Path], typer.Argument(help="Figures that benches wrote with --json.")],
    out: Page = PAGE,
) -> None:
    """Render the page of figures that were measured before."""
    with refusals():
        results = _with_speedup(put_together([read_result(file) for file in files]))
        write(out, render_page(results, _present(out)))
        console.print(f"wrote {out}", highlight=False)


def _with_speedup(results: Sequence[BenchResult]) -> list[BenchResult]:
    """The engine's result with the least speed-up of a skill, where fidelity was measured."""
    speedup = tuple(
        figure
        for result in results
        if result.bench == "fidelity"
        for figure in result.figures
        if figure.name == SPEEDUP
    )
    return [
        replace(result, figures=(*(f for f in result.figures if f.name != SPEEDUP), *speedup))
        if result.bench == "engine" and speedup
        else result
        for result in results
    ]


def _engine(dataset: Path, workload: Path, cycles: int) -> BenchResult:
    machine = describe_machine()
    found, work = Dataset.load(dataset), read_workload(workload)
    with errors.status("engine") as status:

        def on_step(what: str) -> None:
            status.update(f"engine: {what}")

        return BenchResult("engine", commit_here(), machine, bench_engine(found, work, cycles, on_step))


def _rollout(dataset: Path, scenes: int, repeats: int) -> BenchResult:
    machine = describe_machine()
    chosen = scenes_of(Dataset.load(dataset), scenes)
    with errors.status("one process") as status:

        def on_scene(number: int) -> None:
            status.update(f"one process: {number} of {len(chosen)} scenes")

        return BenchResult("rollout", commit_here(), machine, bench_rollout(chosen, repeats, on_scene))


def _fidelity(dataset: Dataset, settings: FidelitySettings, out: Path, jobs: int) -> BenchResult:
    machine = describe_machine() | {"jobs": jobs, "plans_asked": settings.plans, "seed": settings.seed}
    started_s = time.monotonic()
    fresh = not (out / RESULTS_FILE).exists()
    with errors.status("fidelity") as status:
        progress = SuiteProgress(
            written=lambda done, of: status.update(f"fidelity: plans for {done} of {of} scenes"),
            executed=lambda done, of: status.update(f"fidelity: {done} of {of} plans in both modes"),
        )
        outcome = run_fidelity(dataset, settings, out, jobs, MODES, progress)
    minutes = (time.monotonic() - started_s) / 60 if fresh else None
    console.print(skill_table(report_on(outcome.comparisons)))
    for sentence in outcome.lost:
        errors.print(f"lost: {sentence}", highlight=False, markup=False)
    console.print(
        f"disagreements: {out / DISAGREEMENTS_FILE}; see one with --replay {out / DISAGREEMENTS_FILE}:1",
        highlight=False,
    )
    return BenchResult("fidelity", commit_here(), machine, figures_of(outcome, minutes))


def _present(page: Path) -> str:
    return page.read_text(encoding="utf-8") if page.exists() else ""
