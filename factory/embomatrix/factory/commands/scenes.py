"""``embomatrix scene``: build, list, show, draw and check base scenes."""

from __future__ import annotations

import contextlib
import io
import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from embomatrix.factory.floorplan.spec import FloorPlanError
from embomatrix.factory.importers.model import ModelFileError
from embomatrix.factory.importers.shelf import read_assets
from embomatrix.factory.pictures.relations import draw_relations
from embomatrix.factory.pictures.scene import draw_plan
from embomatrix.factory.pictures.sheet import draw_eyes, draw_sheet, draw_views
from embomatrix.factory.scenes.batch import SceneBuildJob, run_batch
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.scene_file import SUFFIX, SceneFileError, read_scene
from embomatrix.factory.scenes.tables import TABLE_COLUMNS, problem_lines, report_table
from embomatrix.host.limits import usable_cores
from embomatrix.sim.bullet.camera import render_oblique
from embomatrix.sim.engine import EngineError
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.whole_file import check_writable, write_whole

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.factory.scenes.report import SceneReport
    from embomatrix.world.scene import Scene

app = typer.Typer(
    help="Build, check and draw base scenes.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
SceneIds = Annotated[list[str] | None, typer.Argument(help="Names of scenes, or none with --all.")]
SceneSource = Annotated[
    str,
    typer.Argument(
        help="Name of a scene, as `embomatrix scene list` shows it, or a .json file that `scene build` wrote."
    ),
]
SceneSources = Annotated[
    list[str] | None,
    typer.Argument(
        help="Names of scenes, or .json files that `scene build` wrote, which have their seed; none with --all."
    ),
]
All = Annotated[bool, typer.Option("--all", help="All 51 scenes.")]
Seed = Annotated[
    int, typer.Option(min=0, help="Another seed gives another arrangement of the same inventory.")
]
Seeds = Annotated[
    list[int] | None,
    typer.Option("--seed", min=0, help="Arrangement of the inventory; give it again for more. Default: 0."),
]
Out = Annotated[Path, typer.Option(help="Folder for the files.")]
Picture = Annotated[Path, typer.Option(help="PNG file to write.")]
Jobs = Annotated[int, typer.Option(min=1, help="Processes at a time.")]
Report = Annotated[
    Path | None, typer.Option(help="JSON file for all figures, problems and what was left out.")
]
Assets = Annotated[
    Path | None,
    typer.Option(help="Folder of imported assets, which take the place of the generated ones."),
]
CORES = usable_cores()
LEFT_OUT = "what is listed and not placed, and why: `embomatrix scene show NAME`, or --report FILE"


@app.command("list")
def list_scenes() -> None:
    """Name the scenes whose inventories are known."""
    catalog = Catalog.load()
    for scene_id in catalog.scene_ids:
        Console().print(catalog.inventory(scene_id).description, highlight=False)


@app.command()
def build(
    scene_ids: SceneIds = None,
    every: All = False,
    seeds: Seeds = None,
    out: Out = Path(),
    report: Report = None,
    jobs: Jobs = CORES,
    assets: Assets = None,
) -> None:
    """Lay out and furnish scenes, check them, and write them as JSON; exit status 1 when one has a problem."""
    chosen = _chosen(scene_ids, every)
    _known(chosen)
    _check_assets(assets)
    _check_writable(report)
    folder = _folder(out)
    several = len(set(seeds or ())) > 1
    orders = [
        SceneBuildJob(name, seed, folder / (f"{name}-{seed}.json" if several else f"{name}.json"), assets)
        for name in chosen
        for seed in dict.fromkeys(seeds or (0,))
    ]
    reports = _run(orders, jobs)
    Console().print(str(orders[0].path if len(orders) == 1 else folder), highlight=False)
    _tell(reports, report)


@app.command()
def check(
    scenes: SceneSources = None,
    every: All = False,
    seeds: Seeds = None,
    report: Report = None,
    jobs: Jobs = CORES,
) -> None:
    """Test scenes for penetration, unstable and floating things and blocked ways; exit status 1 when something is wrong."""
    orders = _to_check(_chosen(scenes, every), tuple(dict.fromkeys(seeds or (0,))))
    _check_writable(report)
    _tell(_run(orders, jobs), report)


@app.command()
def show(scene: SceneSource, seed: Seed = 0) -> None:
    """Print rooms, doorways, objects and what was left out."""
    _print_scene(_built(scene, seed))


@app.command()
def render(scene: SceneSource, seed: Seed = 0, out: Out = Path()) -> None:
    """Draw a plan from above, an oblique view, and what the robot sees around it where it starts, as PNG files."""
    _there([scene])
    folder = _folder(out)
    built = _built(scene, seed)
    with _engine_refusals():
        pictures = {
            "plan": draw_plan(built),
            "view": Image.fromarray(np.asarray(render_oblique(built))),
            "eyes": draw_eyes(built),
        }
    for kind, picture in pictures.items():
        path = folder / f"{built.scene_id}_{kind}.png"
        _write(path, _png(picture))
        Console().print(str(path), highlight=False)


@app.command()
def relations(out: Out = Path()) -> None:
    """Draw what every relation means: cases in which it holds, and in which it does not, as a PNG file."""
    path = _folder(out) / "relations.png"
    with _engine_refusals():
        picture = draw_relations()
    _write(path, _png(picture.quantize(64)))
    Console().print(str(path), highlight=False)


@app.command()
def sheet(
    scenes: SceneSources = None,
    every: All = False,
    seed: Seed = 0,
    out: Picture = Path("scenes.png"),
) -> None:
    """Draw the plans of many scenes on one sheet, as a PNG file."""
    chosen = _chosen(scenes, every)
    _there(chosen)
    _check_writable(out)
    _write(out, _png(draw_sheet(_built_all(chosen, seed)).quantize(64)))
    Console().print(str(out), highlight=False)


@app.command()
def views(scenes: SceneSources = None, seed: Seed = 0, out: Picture = Path("views.png")) -> None:
    """Draw oblique views of some scenes side by side, as a PNG file."""
    chosen = _chosen(scenes, every=False)
    _there(chosen)
    _check_writable(out)
    built = _built_all(chosen, seed)
    with _engine_refusals():
        picture = draw_views(built)
    _write(out, _png(picture.quantize(128)))
    Console().print(str(out), highlight=False)


def _print_scene(scene: Scene) -> None:
    console = Console()
    table = Table("room", "size (m)", "doors to", "windows", "objects")
    for room in scene.rooms:
        doors = [d for d in scene.doorways if room.name in d.rooms]
        beyond = [next((r or "outside" for r in d.rooms if r != room.name), "outside") for d in doors]
        windows = sum(room.name in window.rooms for window in scene.windows)
        counts = Counter(scene.assets[o.asset_id].category for o in scene.objects if o.room == room.name)
        listed = ", ".join(f"{n} {c}" if n > 1 else c for c, n in sorted(counts.items()))
        size = f"{room.size_m[0]:.2f} x {room.size_m[1]:.2f}"
        table.add_row(room.name, size, ", ".join(beyond), str(windows), listed)
    console.print(table)
    for sentence in scene.left_out:
        console.print(f"left out: {sentence}", highlight=False, markup=False)


def _built_all(names: Sequence[str], seed: int) -> list[Scene]:
    """The scenes, one after another, with a bar that tells how far it is."""
    scenes = []
    with _progress(len(names)) as bar:
        for name in names:
            bar.update(bar.task_ids[0], description=name)
            scenes.append(_built(name, seed))
            bar.advance(bar.task_ids[0])
    return scenes


def _check_assets(folder: Path | None) -> None:
    """Before anything is made: a damaged asset shall leave no folder behind."""
    try:
        if folder is not None:
            read_assets(folder)
    except ModelFileError as error:
        raise _refused(str(error)) from None


def _check_writable(path: Path | None) -> None:
    """Before anything is made: minutes of work shall not end at a file that can't be written."""
    if path is None:
        return
    try:
        check_writable(path)
    except OSError as error:
        raise _unwritable(path, error) from None


def _run(orders: Sequence[SceneBuildJob], jobs: int) -> list[SceneReport]:
    reports = []
    with _progress(len(orders)) as bar:
        try:
            for report in run_batch(orders, processes=jobs):
                reports.append(report)
                bar.update(bar.task_ids[0], advance=1, description=report.scene_id)
        except OSError as error:
            raise _unwritable(Path(error.filename or "."), error) from None
    return sorted(reports, key=lambda r: (r.scene_id, r.seed))


def _tell(reports: Sequence[SceneReport], path: Path | None) -> None:
    console = Console()
    Console(width=max(console.width, TABLE_COLUMNS)).print(report_table(reports))
    for line in problem_lines(reports):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if any(report.left_out for report in reports):
        console.print(LEFT_OUT, highlight=False, soft_wrap=True)
    if path is not None:
        _write(path, (json.dumps([r.to_json() for r in reports], indent=1) + "\n").encode("utf-8"))
        console.print(str(path), highlight=False)
    wrong = sum(not report.sound for report in reports)
    if wrong:
        console.print(f"{wrong} of {len(reports)} scenes have problems", highlight=False)
        raise typer.Exit(1)
    console.print(
        f"{len(reports)} scenes, nothing wrong" if len(reports) > 1 else "nothing wrong", highlight=False
    )


def _chosen(names: Sequence[str] | None, every: bool) -> tuple[str, ...]:
    if every and names:
        raise _refused(f"--all and {names[0]!r} exclude one another: give names, or --all")
    if not every and not names:
        raise _refused("no scene is named: give a name that `embomatrix scene list` shows, or --all")
    return Catalog.load().scene_ids if every else tuple(dict.fromkeys(names or ()))


def _to_check(names: Sequence[str], seeds: Sequence[int]) -> list[SceneBuildJob]:
    """Each file once, as it has its own seed, and each inventory with all seeds."""
    orders = []
    for name in names:
        if _is_file(name):
            scene = _read(name)
            orders.append(SceneBuildJob(scene.scene_id, scene.seed, source=Path(name)))
        else:
            _known([name])
            orders += [SceneBuildJob(name, seed) for seed in seeds]
    return orders


def _there(names: Sequence[str]) -> None:
    """Before anything is made: a wrong name or a damaged file shall leave no folder behind."""
    for name in names:
        if _is_file(name):
            _read(name)
        else:
            _known([name])


def _known(names: Sequence[str]) -> None:
    """Before anything is made: a wrong name shall leave no folder behind."""
    try:
        for name in names:
            Catalog.load().inventory(name)
    except CatalogError as error:
        raise _refused(str(error)) from None


def _is_file(name: str) -> bool:
    return name.endswith(SUFFIX)


def _read(name: str) -> Scene:
    try:
        return read_scene(Path(name))
    except SceneFileError as error:
        raise _refused(str(error)) from None


def _built(name: str, seed: int) -> Scene:
    if _is_file(name):
        return _read(name)
    try:
        return build_base_scene(name, seed=seed)
    except (CatalogError, FloorPlanError) as error:
        raise _refused(str(error)) from None


def _progress(total: int) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    progress = Progress(*columns, console=Console(stderr=True), transient=True)
    progress.add_task("scenes", total=total)
    return progress


@contextlib.contextmanager
def _engine_refusals() -> Iterator[None]:
    """A machine without pybullet gets a sentence."""
    try:
        yield
    except EngineError as error:
        raise _refused(str(error)) from None


def _folder(out: Path) -> Path:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(out, error) from None
    return out


def _write(path: Path, data: bytes) -> None:
    try:
        write_whole(path, data)
    except OSError as error:
        raise _unwritable(path, error) from None


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def _unwritable(path: Path, error: OSError) -> typer.Exit:
    return _refused(
        f"{path} can't be written ({error.strerror}): make room, or name another folder with --out"
    )


def _refused(sentence: str) -> typer.Exit:
    Console(stderr=True, soft_wrap=True).print(f"embomatrix scene: {sentence}", highlight=False, markup=False)
    return typer.Exit(2)
