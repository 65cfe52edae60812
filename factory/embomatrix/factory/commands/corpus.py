"""``embomatrix factory corpus``: build the training set and the frozen evaluation set Internal-Verified."""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from embomatrix.factory.commands.options import Jobs, LookAhead, Physical, Seed, in_physics, processes
from embomatrix.factory.commands.terminal import fail, progress, user_errors
from embomatrix.factory.pipeline.build import build_dataset
from embomatrix.factory.pipeline.corpus import HELDOUT_SCENES, CorpusSettings, check_frozen, freeze
from embomatrix.factory.pipeline.settings import BuildSettings

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def corpus(
    out: Annotated[Path, typer.Option(help="Folder for the corpus.")] = Path("build/corpus"),
    train: Annotated[int, typer.Option(min=0, help="Number of training tasks.")] = 2_000,
    heldout: Annotated[int, typer.Option(min=2, help="Number of tasks of Internal-Verified.")] = 100,
    seed: Seed = 0,
    scenes: Annotated[
        list[str] | None,
        typer.Option(help="Scene for training. Repeat the option for more scenes. Default: 45 scenes."),
    ] = None,
    unseen: Annotated[
        list[str] | None, typer.Option(help="Scene that training never sees. Default: six scenes.")
    ] = None,
    jobs: Jobs = None,
    look_ahead: LookAhead = True,
    physical: Physical = None,
    check: Annotated[
        bool,
        typer.Option("--check", help="Build nothing; check that the corpus still has its frozen digest."),
    ] = False,
) -> None:
    """Build the corpus, or resume an interrupted build, and freeze its held-out tasks."""
    console = Console()
    with user_errors(out, f": finished tasks are kept in {out}; run the same command again to resume"):
        if check:
            frozen = check_frozen(out)
        else:
            settings = CorpusSettings(
                train,
                heldout,
                seed,
                tuple(scenes or ()),
                tuple(unseen or HELDOUT_SCENES),
                look_ahead,
                in_physics(physical, look_ahead=look_ahead),
            )
            for name, build in settings.builds().items():
                _build(console, out / name, build, processes(jobs))
            frozen = freeze(out)
    console.print(
        f"Internal-Verified: {frozen.tasks} tasks, {frozen.unseen} in scenes that training never sees, {frozen.digest}",
        highlight=False,
        soft_wrap=True,
    )


def _build(console: Console, folder: Path, settings: BuildSettings, jobs: int) -> None:
    """Run one build with a progress bar."""
    done: Counter[str] = Counter()
    with progress(console) as bars:
        bar = bars.add_task(folder.name, total=settings.train + settings.heldout)

        def update(split: str, admitted: int) -> None:
            done[split] = admitted
            bars.update(bar, completed=done.total())

        summary = build_dataset(folder, settings, update, jobs=jobs)
    for split, wanted in (("train", settings.train), ("heldout", settings.heldout)):
        if summary.total(split) < wanted:
            fail(
                f"only {summary.total(split)} of {wanted} {split} tasks were admitted in {folder}: see attempts.jsonl there, "
                "or ask for fewer"
            )
