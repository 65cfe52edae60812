"""``embomatrix factory starter``: unpack the dataset that ships with the package."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.terminal import say, user_errors
from embomatrix.starter.archive import unpack
from embomatrix.world.dataset import Dataset


def starter(
    out: Annotated[Path, typer.Option(help="Folder for the dataset.")] = Path("build/dataset"),
) -> None:
    """Unpack the dataset that ships with the package."""
    with user_errors(out):
        digest = unpack(out)
        dataset = Dataset.load(out)
    say(f"{len(dataset.train)} training and {len(dataset.heldout)} held-out tasks in {out}: {digest}")
