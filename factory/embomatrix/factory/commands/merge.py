"""``embomatrix factory merge``: one dataset of the tasks of several."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.terminal import fail, say, user_errors
from embomatrix.factory.pipeline.merge import Resolution, conflict_counts, merge_datasets


def merge(
    folders: Annotated[list[Path], typer.Argument(help="Folders of two or more datasets.")],
    out: Annotated[Path, typer.Option(help="New folder for the merged dataset.")],
    resolve: Annotated[
        Resolution,
        typer.Option(
            help="Treatment of training tasks that share a signature, an instruction or a room with a held-out task "
            "of another dataset."
        ),
    ] = Resolution.REFUSE,
) -> None:
    """Merge datasets into a new one. Held-out tasks of one must not occur in the training split of another."""
    if len(folders) < 2:
        fail("found 1 dataset to merge: expected two or more folders")
    with user_errors(out):
        done = merge_datasets(folders, out, resolve)
    train = sum(record.split == "train" for record in done.records)
    say(
        f"{len(done.records)} tasks: {train} for training, {len(done.records) - train} held out; dataset: {out}"
    )
    say(
        f"left out: {done.duplicates} exact duplicates, {done.dropped} tasks that share something with the other split"
    )
    for kind, count in conflict_counts(done.conflicts).items():
        say(f"  {count} pairs share the {kind}")
