"""``embomatrix factory starter``: unpack the dataset that ships with the package, or build it again by its recipe."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.build import make_dataset
from embomatrix.factory.commands.difficulty import measured_records
from embomatrix.factory.commands.options import Jobs
from embomatrix.factory.commands.terminal import fail, say, user_errors
from embomatrix.factory.days.maker import DAYS
from embomatrix.factory.pipeline.settings import BuildSettings, WriterKind
from embomatrix.factory.pipeline.store import BUILD_FILE
from embomatrix.host.own_files import Force
from embomatrix.starter.archive import RECIPE, content_digest, is_shipped, pack, unpack
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, write_dataset


def starter(
    out: Annotated[Path, typer.Option(help="Folder for the dataset.")] = Path("build/dataset"),
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Build the dataset by its recipe, resumably, and compare its digest with that of the shipped one.",
        ),
    ] = False,
    packed: Annotated[
        Path | None,
        typer.Option(help="Build the dataset by its recipe, resumably, and pack it into this file."),
    ] = None,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """Unpack the dataset that ships with the package. With --check or --packed, build it by its recipe; takes an hour."""
    with user_errors(out):
        if not check and packed is None:
            if not force:
                _check_replaceable(out)
            digest = unpack(out)
            dataset = Dataset.load(out)
            say(f"{len(dataset.train)} training and {len(dataset.heldout)} held-out tasks in {out}: {digest}")
            return
        if (out / TASKS_FILE).exists() and not (out / BUILD_FILE).exists():
            fail(f"{out} holds a dataset that no build wrote: name another folder with --out")
        shipped = _comparable(out / "shipped", force=force) if check else ""
        found = _built(out, jobs)
        digest = content_digest(found) if packed is None else pack(found, packed)
        say(f"{len(found.records)} tasks in {out}: {digest}")
        if check:
            if digest != shipped:
                fail(
                    f"the recipe gives {digest}, and the shipped dataset is {shipped}: this version builds other tasks"
                )
            say("the shipped dataset is what its recipe gives")


def _check_replaceable(out: Path) -> None:
    """Exit if the folder holds a dataset other than the shipped one."""
    if not (out / TASKS_FILE).exists():
        return
    try:
        replaceable = is_shipped(Dataset.load(out))
    except DatasetError:
        replaceable = False
    if not replaceable:
        fail(
            f"{out} holds another dataset than the shipped one: name another folder with --out, or pass --force to replace it"
        )


def _comparable(folder: Path, *, force: bool) -> str:
    """Unpack the shipped dataset and return its digest. Exit at once if its size already differs from the recipe's."""
    if not force:
        _check_replaceable(folder)
    digest = unpack(folder)
    shipped = Dataset.load(folder)
    found = (len(shipped.train), len(shipped.heldout))
    if found != (RECIPE.train, RECIPE.heldout):
        fail(
            f"the shipped dataset has {found[0]} training and {found[1]} held-out tasks, and the recipe makes "
            f"{RECIPE.train} and {RECIPE.heldout}: it was not built by this recipe; --packed builds one that is"
        )
    return digest


def _built(out: Path, jobs: int | None) -> Dataset:
    """Build the dataset of the recipe and store the difficulty of its tasks."""
    settings = BuildSettings(RECIPE.train, RECIPE.heldout, RECIPE.seed, RECIPE.scenes, WriterKind.SOCIAL)
    make_dataset(out, settings, jobs=jobs, making=DAYS)
    dataset = Dataset.load(out)
    write_dataset(out, measured_records(dataset, jobs), {})
    return Dataset.load(out)
