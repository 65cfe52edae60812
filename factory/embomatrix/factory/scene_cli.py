"""``embomatrix scene``: build, list, show, draw and check base scenes."""

from __future__ import annotations

import io
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from PIL import Image
from rich.console import Console
from rich.table import Table

from embomatrix.factory.floorplan_spec import FloorPlanError
from embomatrix.factory.pictures import draw_plan
from embomatrix.factory.relation_pictures import draw_relations
from embomatrix.factory.scene_build import build_base_scene
from embomatrix.factory.scene_check import check_in_engine, check_scene
from embomatrix.sim.bullet.camera import render_oblique
from embomatrix.sim.engine import EngineError
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.codec import scene_to_json
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene

app = typer.Typer(
    help="Build, check and draw base scenes.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
SceneId = Annotated[str, typer.Argument(help="Name of a scene, as `embomatrix scene list` shows it.")]
Seed = Annotated[int, typer.Option(help="Another seed gives another arrangement of the same inventory.")]
Out = Annotated[Path, typer.Option(help="Folder for the files.")]


@app.command("list")
def list_scenes() -> None:
    """Name the scenes whose inventories are known."""
    catalog = Catalog.load()
    for scene_id in catalog.scene_ids:
        Console().print(catalog.inventory(scene_id).description, highlight=False)


@app.command()
def build(scene_id: SceneId, seed: Seed = 0, out: Out = Path()) -> None:
    """Lay out and furnish a scene, and write it as JSON."""
    import json

    _check_name(scene_id)
    path = _folder(out) / f"{scene_id}.json"
    scene = _built(scene_id, seed)
    _write(path, json.dumps(scene_to_json(scene)).encode("utf-8"))
    Console().print(f"{len(scene.rooms)} rooms, {len(scene.objects)} objects: {path}", highlight=False)


@app.command()
def show(scene_id: SceneId, seed: Seed = 0) -> None:
    """Print rooms, doorways, objects and what was left out."""
    scene = _built(scene_id, seed)
    console = Console()
    table = Table("room", "size (m)", "doors to", "objects")
    for room in scene.rooms:
        doors = [d for d in scene.doorways if room.name in d.rooms]
        beyond = [next((r or "outside" for r in d.rooms if r != room.name), "outside") for d in doors]
        counts = Counter(scene.assets[o.asset_id].category for o in scene.objects if o.room == room.name)
        listed = ", ".join(f"{n} {c}" if n > 1 else c for c, n in sorted(counts.items()))
        table.add_row(room.name, f"{room.size_m[0]:.2f} x {room.size_m[1]:.2f}", ", ".join(beyond), listed)
    console.print(table)
    for sentence in scene.left_out:
        console.print(f"left out: {sentence}", highlight=False, markup=False)


@app.command()
def render(scene_id: SceneId, seed: Seed = 0, out: Out = Path()) -> None:
    """Draw a plan from above and an oblique view, as PNG files."""
    _check_name(scene_id)
    folder = _folder(out)
    scene = _built(scene_id, seed)
    plan, oblique = folder / f"{scene_id}_plan.png", folder / f"{scene_id}_view.png"
    _write(plan, _png(draw_plan(scene)))
    try:
        view = render_oblique(scene)
    except EngineError as error:
        raise _refused(str(error)) from None
    _write(oblique, _png(Image.fromarray(np.asarray(view))))
    Console().print(f"{plan}\n{oblique}", highlight=False)


@app.command()
def check(scene_id: SceneId, seed: Seed = 0) -> None:
    """Test a scene for penetration, floating things and blocked ways; exit status 1 when something is wrong."""
    scene = _built(scene_id, seed)
    try:
        problems = (*check_scene(scene), *check_in_engine(scene))
    except EngineError as error:
        raise _refused(str(error)) from None
    for problem in problems:
        Console().print(f"{problem.kind}: {', '.join(problem.names)}: {problem.detail}", highlight=False)
    if problems:
        raise typer.Exit(1)
    Console().print(f"{scene_id}: {len(scene.objects)} objects, nothing wrong", highlight=False)


@app.command()
def relations(out: Out = Path()) -> None:
    """Draw what every relation means: cases in which it holds, and in which it does not, as a PNG file."""
    path = _folder(out) / "relations.png"
    try:
        picture = draw_relations()
    except EngineError as error:
        raise _refused(str(error)) from None
    _write(path, _png(picture.quantize(64)))
    Console().print(str(path), highlight=False)


def _check_name(scene_id: str) -> None:
    """Before anything is made: a wrong name shall leave no folder behind."""
    try:
        Catalog.load().inventory(scene_id)
    except CatalogError as error:
        raise _refused(str(error)) from None


def _built(scene_id: str, seed: int) -> Scene:
    try:
        return build_base_scene(scene_id, seed=seed)
    except (CatalogError, FloorPlanError) as error:
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
    image.save(buffer, format="PNG")
    return buffer.getvalue()


def _unwritable(path: Path, error: OSError) -> typer.Exit:
    return _refused(
        f"{path} can't be written ({error.strerror}): make room, or name another folder with --out"
    )


def _refused(sentence: str) -> typer.Exit:
    Console(stderr=True, soft_wrap=True).print(f"embomatrix scene: {sentence}", highlight=False, markup=False)
    return typer.Exit(2)
