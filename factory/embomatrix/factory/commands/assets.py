"""``embomatrix factory assets``: list the catalog, test the generated assets, draw them, and import models from files."""

import math
from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.table import Column

from embomatrix.factory.assets.check import AssetRule, check_asset, check_standing
from embomatrix.factory.assets.library import build_asset, family_of
from embomatrix.factory.commands.terminal import fail, say, show_table, user_errors
from embomatrix.factory.importers.assemble import ImportedAsset, import_model, read_model
from embomatrix.factory.importers.convex import Coacd, by_components
from embomatrix.factory.importers.model import AxisConvention, ModelFileError
from embomatrix.factory.importers.shelf import ASSET_MARK, asset_file, save_asset
from embomatrix.factory.pictures.assets import draw_sheet
from embomatrix.factory.pictures.marked_files import write_picture
from embomatrix.factory.task_import.task_file import SENSES
from embomatrix.host.commands import command_group
from embomatrix.host.own_files import PICTURE_MARK, Force, keep_foreign, prepare_output
from embomatrix.world.asset import Asset, Credit
from embomatrix.world.catalog import Catalog
from embomatrix.world.records import SceneInvalidError

app = command_group(help="List, test, draw and import the models that scenes are built from.")
WORTH_TELLING: Final = 1.25
"""Ratio of the largest to the smallest scale from which a distorted model is reported."""
ABILITIES: Final = {
    "openable": "opens",
    "toggleable": "switches on",
    "heatSource": "heats",
    "coldSource": "cools",
    "waterSource": "gives water",
    "particleRemover": "cleans",
    "slicer": "cuts",
    "sliceable": "can be cut",
    "cookable": "can be cooked",
}
"""Abilities in words, by their names in the catalog. Others matter to no skill."""


class Cut(StrEnum):
    """Convex decomposition method."""

    COACD = "coacd"
    COMPONENTS = "components"


Categories = Annotated[list[str] | None, typer.Option("--category", help="Only this category; repeatable.")]


@app.command("list")
def list_(
    word: Annotated[
        str,
        typer.Argument(help="Part of a name such as cabinet, or a kind such as fruit. Default: everything."),
    ] = "",
) -> None:
    """List the catalog's categories of objects, whose names task files, floor plans and `assets import` use.

    Sizes are those of the middle model by volume: depth, width and height.
    """
    catalog = Catalog.load()
    with user_errors():
        found = _categories_like(catalog, word)
    if not found:
        fail(
            f"no category of the catalog has {word!r} in its name, or is a kind of it: try a shorter or a more general word"
        )
    rows = [_described(catalog, name) for name in found]
    columns: list[str | Column] = [
        Column("category", no_wrap=True),
        Column("models", justify="right"),
        Column("cm", justify="right", no_wrap=True),
        Column("kg", justify="right"),
        "abilities",
    ]
    show_table(columns, rows)
    say(f"{len(found):,} of {len(catalog.category_names):,} categories")


@app.command()
def check(
    category: Categories = None,
    every_model: Annotated[
        bool, typer.Option("--every-model", help="All models of a category instead of the first.")
    ] = False,
) -> None:
    """Check size, cavities, doors and stability of all assets in use, and count their families.

    Exit status 1 if an asset breaks a rule.
    """
    catalog = Catalog.load()
    with user_errors():
        assets = _assets(catalog, category, every_model=every_model)
        findings = [finding for asset in assets for finding in check_asset(catalog, asset)]
        findings += check_standing(catalog, assets)
    for finding in findings:
        if not finding.excused:
            say(f"{finding.asset_id}: {finding.rule}: {finding.detail}")
    counts = Counter((finding.rule, finding.excused) for finding in findings)
    rows = ((rule, counts[rule, False], counts[rule, True]) for rule in AssetRule)
    show_table(("rule", "wrong", "excused"), rows, f"{len(assets)} models")
    reasons = Counter(f"{finding.rule}: {finding.detail}" for finding in findings if finding.excused)
    for reason, number in sorted(reasons.items()):
        say(f"excused {number} x {reason}")
    families = Counter(family_of(catalog, name) for name in {asset.category for asset in assets})
    show_table(("family", "categories"), families.most_common(), f"{families.total()} categories")
    if any(not finding.excused for finding in findings):
        raise typer.Exit(1)


@app.command()
def draw(
    out: Annotated[
        Path | None, typer.Option(help="PNG file to write. Default: assets.png in the current folder.")
    ] = None,
    category: Categories = None,
    every_model: Annotated[bool, typer.Option("--every-model", help="All models of a category.")] = False,
    force: Force = False,
) -> None:
    """Draw assets side by side, closed and open. Default: all categories that open, heat or cool."""
    catalog = Catalog.load()
    chosen = category or [name for name in catalog.used_categories if _is_worth_a_look(catalog, name)]
    file = out or Path("assets.png")
    if out is None:
        keep_foreign("", [file], PICTURE_MARK, force=force)
    prepare_output("factory assets draw", file)
    with user_errors(file, more=(ValueError,)):
        write_picture(file, draw_sheet(_assets(catalog, chosen, every_model=every_model)))
    say(file)


@app.command("import")
def import_(
    file: Annotated[Path, typer.Argument(help="OBJ, STL, GLB or URDF.")],
    category: Annotated[str, typer.Option(help="Category of the model in the catalog.")],
    creator: Annotated[str, typer.Option(help="Author of the model.")],
    licence: Annotated[str, typer.Option(help="Licence of the model, e.g. CC0-1.0.")],
    out: Annotated[Path, typer.Option(help="Folder of imported assets.")],
    model: Annotated[
        str,
        typer.Option(
            help="Model of the catalog to replace. Default: the one with the most similar proportions."
        ),
    ] = "",
    source: Annotated[str, typer.Option(help="Source of the model. Default: the file's name.")] = "",
    up: Annotated[
        AxisConvention | None, typer.Option(help="Axis that points up: y (OBJ, GLB) or z (STL, URDF).")
    ] = None,
    cut: Annotated[Cut, typer.Option(help="Convex decomposition of meshes.")] = Cut.COACD,
    force: Force = False,
) -> None:
    """Import a model file as an asset that replaces one of the catalog's models in `scene build --assets`."""
    credit = Credit(creator, licence, source or file.name)
    with user_errors(out, more=(ModelFileError, SceneInvalidError)):
        raw = read_model(file, up)
        decompose = Coacd() if cut is Cut.COACD else by_components
        imported = import_model(Catalog.load(), raw, category, model, credit, decompose)
        out.mkdir(parents=True, exist_ok=True)
        keep_foreign("", [asset_file(out, imported.asset)], ASSET_MARK, force=force)
        path = save_asset(out, imported.asset)
    _tell(imported, path)
    say(_stands_in(imported.asset.asset_id))


def _categories_like(catalog: Catalog, word: str) -> list[str]:
    """Return the categories with the word in their names, and those that a synset of this name includes."""
    part = word.lower().replace(" ", "_")
    kinds = {
        name
        for sense in SENSES
        if part and catalog.has_synset(f"{part}.{sense}")
        for name in catalog.categories_of(f"{part}.{sense}")
    }
    return [name for name in catalog.category_names if part in name or name in kinds]


def _described(catalog: Catalog, name: str) -> tuple[str, str, str, str, str]:
    """Return the row of a category: name, models, size, mass and abilities."""
    category, models = catalog.category(name), catalog.models_of(name)
    middle = sorted(models, key=lambda model: math.prod(model.size_m))[len(models) // 2]
    size = " × ".join(f"{100 * side:.0f}" for side in middle.size_m)
    abilities = ", ".join(words for ability, words in ABILITIES.items() if ability in category.abilities)
    return name, str(len(models)), size, f"{category.mass_kg:g}", abilities


def _tell(imported: ImportedAsset, path: Path) -> None:
    """Print contents, missing abilities, and broken rules of the imported asset."""
    asset = imported.asset
    parts = sum(len(link.parts) for link in asset.links)
    say(
        f"{asset.asset_id}: convex parts {parts}, links {len(asset.links)}, surfaces {len(asset.supports)}, cavities "
        f"{len(asset.interiors)}: {path}"
    )
    for lack in imported.lacks:
        say(lack)
    for finding in check_asset(Catalog.load(), asset):
        # Missing parts were already reported above.
        if not finding.excused and not imported.lacks:
            say(f"{finding.rule.value}: {finding.detail}")
    if imported.stretch > WORTH_TELLING:
        say(
            f"its proportions are changed by a factor of {imported.stretch:.2f} to fit {asset.size_m} m: "
            "another --model may be more similar"
        )


def _stands_in(asset_id: str) -> str:
    """Return a sentence on the base scenes that use the asset."""
    catalog = Catalog.load()
    listing = [
        scene_id
        for scene_id in catalog.scene_ids
        if any(
            f"{category}-{model}" == asset_id
            for room in catalog.inventory(scene_id).rooms
            for category, model, _ in room.items
        )
    ]
    return (
        f"it is used in {', '.join(listing)}, built with --assets"
        if listing
        else "no base scene lists this model: give a --model that one lists, or ask for it in a floor plan: "
        f"furniture = {{{asset_id} = 1}}"
    )


def _is_worth_a_look(catalog: Catalog, name: str) -> bool:
    return not {"openable", "heatSource", "coldSource"}.isdisjoint(catalog.category(name).abilities)


def _assets(catalog: Catalog, categories: Sequence[str] | None, *, every_model: bool) -> list[Asset]:
    return [
        build_asset(catalog, name, model.model_id)
        for name in categories or catalog.used_categories
        for model in catalog.models_of(name)[: None if every_model else 1]
    ]
