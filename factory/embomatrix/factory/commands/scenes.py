"""``embomatrix scene``: build, list, show, draw and check base scenes."""

import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from PIL import Image
from rich.console import Console

from embomatrix.factory.commands.terminal import fail, progress, say, show_table, user_errors
from embomatrix.factory.floorplan.house_file import SUFFIX as HOUSE_SUFFIX
from embomatrix.factory.floorplan.house_file import HouseFileError, read_house
from embomatrix.factory.floorplan.procthor import MARK as HOUSE_MARK
from embomatrix.factory.floorplan.procthor import house_file_of
from embomatrix.factory.floorplan.spec import FloorPlanError
from embomatrix.factory.importers.model import ModelFileError
from embomatrix.factory.importers.shelf import read_assets
from embomatrix.factory.pictures.marked_files import write_picture
from embomatrix.factory.pictures.relations import draw_relations
from embomatrix.factory.pictures.scene import draw_plan
from embomatrix.factory.pictures.sheet import (
    draw_eyes,
    draw_oblique,
    draw_sheet,
    draw_tagged_eyes,
    draw_tagged_oblique,
    draw_views,
)
from embomatrix.factory.scenes.batch import SceneBuildJob, run_batch
from embomatrix.factory.scenes.build import build_base_scene, build_house
from embomatrix.factory.scenes.report import TABLE_COLUMNS, SceneReport, problem_lines, report_table
from embomatrix.factory.scenes.scene_file import SCENE_MARKS, SUFFIX, SceneFileError, read_scene
from embomatrix.host.commands import command_group
from embomatrix.host.limits import usable_cores
from embomatrix.host.own_files import PICTURE_MARK, Force, keep_foreign, prepare_output
from embomatrix.world.catalog import Catalog
from embomatrix.world.scene import Scene
from embomatrix.world.whole_file import write_whole

app = command_group(help="Build, check and draw base scenes.")


class Drawing(StrEnum):
    """Kinds of pictures that ``scene draw`` makes."""

    SCENE = "scene"
    SHEET = "sheet"
    VIEWS = "views"
    RELATIONS = "relations"


class PictureFormat(StrEnum):
    """Formats of rendered pictures; the value is the suffix of the file."""

    PNG = "png"
    JPEG = "jpg"


SceneIds = Annotated[
    list[str] | None,
    typer.Argument(help="Names of scenes, or .toml files of floor plans (docs/scenes.md); none with --all."),
]
SceneSource = Annotated[
    str,
    typer.Argument(
        help="Name of a scene (see `embomatrix scene list`), a .json file of `scene build`, or a .toml file of a floor plan."
    ),
]
SceneSources = Annotated[
    list[str] | None,
    typer.Argument(
        help="Names of scenes, .json files of `scene build`, or .toml files of floor plans; none with --all."
    ),
]
All = Annotated[bool, typer.Option("--all", help="All 51 scenes.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the arrangement. Files have their own seed.")]
Seeds = Annotated[
    list[int] | None, typer.Option("--seed", min=0, help="Seed of the arrangement; repeatable. Default: 0.")
]
Out = Annotated[Path, typer.Option(help="Output folder.")]
Kind = Annotated[
    Drawing,
    typer.Option(
        "--as",
        help="Plan, oblique view and robot's view of each scene; a sheet of all their plans; their oblique views side "
        "by side; or examples and counterexamples of every relation, without scenes.",
    ),
]
LabelsOption = Annotated[
    bool,
    typer.Option(
        "--labels", help="Write the names of visible objects into the oblique view and the robot's view."
    ),
]
FormatOption = Annotated[
    PictureFormat,
    typer.Option(
        "--format", help="Format of rendered pictures; JPEG files are smaller. Plans are PNG files."
    ),
]
Jobs = Annotated[int, typer.Option(min=1, help="Number of processes.")]
Report = Annotated[
    Path | None, typer.Option(help="JSON file for all figures, problems and objects left out.")
]
Assets = Annotated[Path | None, typer.Option(help="Folder of imported assets that replace generated ones.")]
Background = Annotated[
    bool, typer.Option(help="Fill homes with background objects, as many as real rooms hold.")
]
VIEW_PX = (1280, 960)
"""Size of the oblique view of a scene."""
CORES = usable_cores()
_user_errors = partial(user_errors, more=(FloorPlanError, HouseFileError, ModelFileError, SceneFileError))
LEFT_OUT = "for objects that were left out, and why: `embomatrix scene show NAME`, or --report FILE"


@app.command("list")
def list_scenes() -> None:
    """List the scenes of the catalog."""
    catalog = Catalog.load()
    for scene_id in catalog.scene_ids:
        say(catalog.inventory(scene_id).description)


@app.command()
def build(
    scene_ids: SceneIds = None,
    every: All = False,
    seeds: Seeds = None,
    out: Out = Path(),
    report: Report = None,
    jobs: Jobs = CORES,
    assets: Assets = None,
    background: Background = True,
    force: Force = False,
) -> None:
    """Lay out and furnish scenes, check them, and write them as JSON; exit status 1 if one has a problem."""
    chosen = _chosen(scene_ids, every)
    # Bad input is reported before anything is written or hours of work begin.
    with _user_errors():
        houses = _houses(chosen)
        if assets is not None:
            read_assets(assets)
    prepare_output("scene build", report)
    with _user_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    several = len(set(seeds or ())) > 1
    orders = [
        SceneBuildJob(
            name,
            seed,
            out / (f"{name}-{seed}.json" if several else f"{name}.json"),
            assets,
            house=house,
            background=background,
        )
        for name, house in houses.items()
        for seed in dict.fromkeys(seeds or (0,))
    ]
    keep_foreign("", [order.path for order in orders if order.path is not None], *SCENE_MARKS, force=force)
    reports = _run(orders, jobs)
    say(orders[0].path if len(orders) == 1 else out)
    for done in reports:
        if done.scene_id in houses and houses[done.scene_id] is not None:
            for sentence in done.left_out:
                say(f"left out of {done.scene_id}: {sentence}")
    _print_reports(reports, report)


@app.command("import")
def import_house(
    house: Annotated[Path, typer.Argument(help="JSON file of a house of ProcTHOR.")],
    out: Annotated[Path | None, typer.Option(help="House file to write. Default: NAME.toml.")] = None,
    name: Annotated[str, typer.Option(help="Name of the scene. Default: that of the file.")] = "",
    force: Force = False,
) -> None:
    """Write a house of ProcTHOR as a floor plan for `scene build`: rooms, doors, windows, and counts of furniture."""
    scene = re.sub(r"[^A-Za-z0-9_]+", "_", name or house.stem)[:40]
    path = out or Path(f"{scene}{HOUSE_SUFFIX}")
    keep_foreign("scene import", [path], HOUSE_MARK, force=force)
    with _user_errors():
        text, notes = house_file_of(house, scene)
    prepare_output("scene import", path)
    with _user_errors(path):
        write_whole(path, text.encode("utf-8"))
    say(path)
    for note in notes:
        say(f"left out: {note}")
    with _user_errors():
        try:
            read_house(path)
        except HouseFileError as error:
            fail(f"{error}; edit the file: the house of {house} does not fit our rules as it is")


@app.command()
def check(
    scenes: SceneSources = None,
    every: All = False,
    seeds: Seeds = None,
    report: Report = None,
    jobs: Jobs = CORES,
) -> None:
    """Check scenes for penetration, instability, floating objects and blocked ways; exit status 1 on a problem."""
    orders = []
    with _user_errors():
        for name in _chosen(scenes, every):
            if name.endswith(SUFFIX):
                scene = read_scene(Path(name))
                orders.append(SceneBuildJob(scene.scene_id, scene.seed, source=Path(name)))
                continue
            for scene_id, house in _houses([name]).items():
                orders += [
                    SceneBuildJob(scene_id, seed, house=house) for seed in dict.fromkeys(seeds or (0,))
                ]
    prepare_output("scene check", report)
    _print_reports(_run(orders, jobs), report)


@app.command()
def show(scene: SceneSource, seed: Seed = 0) -> None:
    """Print rooms, doorways, objects, and what was left out."""
    with _user_errors():
        built = _built(scene, seed)
    rows = []
    for room in built.rooms:
        doors = [d for d in built.doorways if room.name in d.rooms]
        beyond = [next((r or "outside" for r in d.rooms if r != room.name), "outside") for d in doors]
        windows = sum(room.name in window.rooms for window in built.windows)
        mine = [item.asset_id for item in built.objects if item.room == room.name]
        mine += [item.asset_id for item in built.background if item.room == room.name]
        counts = Counter(built.assets[asset_id].category for asset_id in mine)
        listed = ", ".join(f"{n} {c}" if n > 1 else c for c, n in sorted(counts.items()))
        size = f"{room.size_m[0]:.2f} x {room.size_m[1]:.2f}"
        rows.append((room.name, size, ", ".join(beyond), windows, listed))
    show_table(("room", "size (m)", "doors to", "windows", "objects"), rows)
    for sentence in built.left_out:
        say(f"left out: {sentence}")


@app.command()
def draw(
    scenes: SceneSources = None,
    every: All = False,
    kind: Kind = Drawing.SCENE,
    seed: Seed = 0,
    out: Out = Path(),
    labels: LabelsOption = False,
    file_format: FormatOption = PictureFormat.PNG,
    force: Force = False,
) -> None:
    """Draw scenes or examples of the relations as PNG files in a folder."""
    if labels and kind is not Drawing.SCENE:
        fail(
            f"found --labels with --as {kind}: names are written into the oblique view and the robot's view of single "
            f"scenes; leave out --labels, or leave out --as"
        )
    names = () if kind is Drawing.RELATIONS else _chosen(scenes, every)
    with _user_errors(out):
        for name in names:
            _check_source(name)
        out.mkdir(parents=True, exist_ok=True)
        with progress() as bars:
            built = [_built(name, seed) for name in bars.track(names, description="scenes")]
        titles = _titles(kind, built)
        files = {
            each: out / f"{each}.{file_format if rendered else PictureFormat.PNG}"
            for each, rendered in titles.items()
        }
        keep_foreign("", files.values(), PICTURE_MARK, force=force)
        for title, picture in _tagged_pictures(built) if labels else _pictures(kind, built):
            write_picture(files[title], picture)
            say(files[title])


def _titles(kind: Drawing, scenes: Sequence[Scene]) -> dict[str, bool]:
    """Return the titles of all pictures of a kind: True for rendered ones, which have soft shades, not lines and text."""
    if kind is not Drawing.SCENE:
        return {kind.value: kind is not Drawing.SHEET}
    return {
        f"{scene.scene_id}_{view}": view != "plan" for scene in scenes for view in ("plan", "view", "eyes")
    }


def _tagged_pictures(scenes: Sequence[Scene]) -> Iterator[tuple[str, Image.Image]]:
    """Yield the pictures of each scene with their titles, names in all of them. Raise EngineError without pybullet."""
    for scene in scenes:
        yield f"{scene.scene_id}_plan", draw_plan(scene)
        yield f"{scene.scene_id}_view", draw_tagged_oblique(scene, VIEW_PX)
        yield f"{scene.scene_id}_eyes", draw_tagged_eyes(scene)


def _pictures(kind: Drawing, scenes: Sequence[Scene]) -> Iterator[tuple[str, Image.Image]]:
    """Yield pictures of a kind with their titles. Raise EngineError without pybullet."""
    match kind:
        case Drawing.SCENE:
            for scene in scenes:
                yield f"{scene.scene_id}_plan", draw_plan(scene)
                yield f"{scene.scene_id}_view", draw_oblique(scene, VIEW_PX)
                yield f"{scene.scene_id}_eyes", draw_eyes(scene)
        case Drawing.SHEET:
            yield "sheet", draw_sheet(scenes).quantize(64)
        case Drawing.VIEWS:
            yield "views", draw_views(scenes)
        case Drawing.RELATIONS:
            yield "relations", draw_relations()


def _run(orders: Sequence[SceneBuildJob], jobs: int) -> list[SceneReport]:
    with _user_errors(), progress() as bars:
        reports = bars.track(run_batch(orders, processes=jobs), total=len(orders), description="scenes")
        return sorted(reports, key=lambda r: (r.scene_id, r.seed))


def _print_reports(reports: Sequence[SceneReport], path: Path | None) -> None:
    console = Console()
    Console(width=max(console.width, TABLE_COLUMNS)).print(report_table(reports))
    for line in problem_lines(reports):
        say(line)
    if any(report.left_out for report in reports):
        say(LEFT_OUT)
    if path is not None:
        with _user_errors(path):
            write_whole(path, (json.dumps([r.to_json() for r in reports], indent=1) + "\n").encode("utf-8"))
        say(path)
    wrong = sum(not report.sound for report in reports)
    if wrong:
        say(f"{wrong} of {len(reports)} scenes have problems")
        raise typer.Exit(1)
    say(f"{len(reports)} scenes, nothing wrong" if len(reports) > 1 else "nothing wrong")


def _chosen(names: Sequence[str] | None, every: bool) -> tuple[str, ...]:
    if every and names:
        fail(f"found both --all and {names[0]!r}: give names or --all")
    if not every and not names:
        fail("no scene is named: give a name that `embomatrix scene list` shows, or --all")
    return Catalog.load().scene_ids if every else tuple(dict.fromkeys(names or ()))


def _houses(names: Sequence[str]) -> dict[str, Path | None]:
    """Return the scenes to build by name, each with its house file or None for one of the catalog.

    Raise HouseFileError or CatalogError; a scene that is named twice is a HouseFileError.
    """
    found: dict[str, Path | None] = {}
    for name in names:
        path = Path(name) if name.endswith(HOUSE_SUFFIX) else None
        if path is None and Path(name).is_file():
            raise HouseFileError(
                f"{name} is no floor plan: expected the name of a base scene, or a file that ends in {HOUSE_SUFFIX}"
            )
        scene_id = Catalog.load().inventory(name).scene_id if path is None else read_house(path).scene
        if scene_id in found:
            raise HouseFileError(
                f"{path} and {found[scene_id]} both describe the scene {scene_id!r}: change `scene` in one of them"
            )
        found[scene_id] = path
    return found


def _check_source(name: str) -> None:
    """Raise SceneFileError, HouseFileError or CatalogError unless a scene can be read or built."""
    if name.endswith(SUFFIX):
        read_scene(Path(name))
    else:
        _houses([name])


def _built(name: str, seed: int) -> Scene:
    if name.endswith(SUFFIX):
        return read_scene(Path(name))
    if name.endswith(HOUSE_SUFFIX):
        return build_house(read_house(Path(name)), seed=seed)
    return build_base_scene(name, seed=seed)
