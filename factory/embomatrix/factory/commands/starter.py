"""``embomatrix factory starter``: unpack the starter dataset, all tasks that ship with the package."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.terminal import fail, say, user_errors
from embomatrix.host.own_files import Force
from embomatrix.starter.shipped import holds_shipped, unpack
from embomatrix.world.dataset import TASKS_FILE, Dataset


def starter(
    out: Annotated[Path, typer.Option(help="Folder for the dataset.")] = Path("build/dataset"),
    force: Force = False,
) -> None:
    """Unpack the starter dataset that ships with the package."""
    with user_errors(out):
        if not force:
            _check_replaceable(out)
        digest = unpack(out)
        dataset = Dataset.load(out)
        say(f"{len(dataset.train)} training and {len(dataset.heldout)} held-out tasks in {out}: {digest}")


def _check_replaceable(out: Path) -> None:
    """Exit if the folder holds a dataset other than the starter dataset."""
    if (out / TASKS_FILE).exists() and not holds_shipped(out):
        fail(
            f"{out} holds another dataset than the starter dataset: name another folder with --out, or pass --force to "
            "replace it"
        )
