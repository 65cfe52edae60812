"""``embomatrix factory corpus``: the set to train on, and Internal-Verified, frozen under its digest."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from embomatrix.factory.commands.terminal import fail, mended, progress
from embomatrix.factory.pipeline.build import build_dataset
from embomatrix.factory.pipeline.corpus import HELDOUT_SCENES, CorpusSettings, check_frozen, freeze
from embomatrix.factory.pipeline.options import Jobs, Physical, is_proved, processes

if TYPE_CHECKING:
    from embomatrix.factory.pipeline.settings import BuildSettings

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def corpus(
    out: Annotated[Path, typer.Option(help="Folder for the corpus.")] = Path("build/corpus"),
    train: Annotated[int, typer.Option(min=0, help="Tasks to train on.")] = 2_000,
    heldout: Annotated[int, typer.Option(min=2, help="Tasks of Internal-Verified.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal corpora.")] = 0,
    scenes: Annotated[
        list[str] | None, typer.Option(help="Scene to train in; give it again for more. Default: 45.")
    ] = None,
    unseen: Annotated[
        list[str] | None, typer.Option(help="Scene that training never sees. Default: six.")
    ] = None,
    jobs: Jobs = None,
    look_ahead: Annotated[bool, typer.Option(help="Find out what the arm can do in each scene.")] = True,
    physical: Physical = None,
    check: Annotated[
        bool, typer.Option("--check", help="Make nothing: tell whether the corpus is as it was frozen.")
    ] = False,
) -> None:
    """Make the corpus, or go on with one that was cut short; freeze its held-out tasks."""
    console = Console()
    kept = f": what was made is kept in {out}, and the same command goes on from there"
    with mended(out, kept):
        if check:
            frozen = check_frozen(out)
        else:
            chosen, others = tuple(scenes or ()), tuple(unseen or HELDOUT_SCENES)
            proof = is_proved(physical, look_ahead=look_ahead)
            settings = CorpusSettings(train, heldout, seed, chosen, others, look_ahead, proof)
            _make(console, out, settings, processes(jobs))
            frozen = freeze(out)
    console.print(
        f"Internal-Verified: {frozen.tasks} tasks, {frozen.unseen} in scenes that training never sees, {frozen.digest}",
        highlight=False,
        soft_wrap=True,
    )


def _make(console: Console, out: Path, settings: CorpusSettings, jobs: int) -> None:
    for name, build in settings.builds().items():
        _build(console, out / name, build, jobs)


def _build(console: Console, folder: Path, settings: BuildSettings, jobs: int) -> None:
    """One build with its bar."""
    done: Counter[str] = Counter()
    with progress(console) as bars:
        bar = bars.add_task(folder.name, total=settings.train + settings.heldout)

        def told(split: str, admitted: int) -> None:
            done[split] = admitted
            bars.update(bar, completed=done.total())

        summary = build_dataset(folder, settings, told, jobs=jobs)
    for split, wanted in (("train", settings.train), ("heldout", settings.heldout)):
        if summary.total(split) < wanted:
            fail(
                f"only {summary.total(split)} of {wanted} {split} tasks were admitted in {folder}: see attempts.jsonl there, "
                "or ask for fewer"
            )
