"""``embomatrix factory starter``: build the dataset that ships with the package by its recipe, and pack it."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.build import make_dataset
from embomatrix.factory.commands.options import Jobs
from embomatrix.factory.commands.terminal import fail, say, user_errors
from embomatrix.factory.days.maker import DAYS
from embomatrix.factory.pipeline.settings import BuildSettings, WriterKind
from embomatrix.world.dataset import Dataset
from embomatrix.world.starter import RECIPE, content_digest, pack, unpack


def starter(
    out: Annotated[Path, typer.Option(help="Folder for the dataset.")] = Path("build/starter"),
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Build it by the recipe and compare the result with the shipped dataset."
        ),
    ] = False,
    packed: Annotated[
        Path | None, typer.Option(help="Also build it by the recipe and pack it into this file.")
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Unpack the dataset that ships with the package. With --check or --packed, build it again by its recipe, resumably."""
    with user_errors(out):
        if not check and packed is None:
            say(f"{len(_unpacked(out).records)} tasks in {out}: {content_digest(Dataset.load(out))}")
            return
        settings = BuildSettings(RECIPE.train, RECIPE.heldout, RECIPE.seed, RECIPE.scenes, WriterKind.SOCIAL)
        make_dataset(out, settings, jobs=jobs, making=DAYS)
        built = Dataset.load(out)
        found = content_digest(built) if packed is None else pack(built, packed)
        say(f"{len(built.records)} tasks: {found}")
        if check:
            shipped = content_digest(_unpacked(out / "shipped"))
            if found != shipped:
                fail(
                    f"the recipe gives {found}, and the shipped dataset is {shipped}: this version builds other tasks"
                )
            say("the shipped dataset is what its recipe gives")


def _unpacked(folder: Path) -> Dataset:
    unpack(folder)
    return Dataset.load(folder)
