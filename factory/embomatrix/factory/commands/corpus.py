"""``embomatrix factory corpus``: build the training set and the frozen evaluation set Internal-Verified."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.build import make_dataset
from embomatrix.factory.commands.options import Jobs, LookAhead, Physical, Seed, in_physics
from embomatrix.factory.commands.terminal import say, user_errors
from embomatrix.factory.days.maker import DAYS
from embomatrix.factory.pipeline.corpus import HELDOUT_SCENES, CorpusSettings, check_frozen, freeze


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
    with user_errors(out):
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
                make_dataset(out / name, build, jobs=jobs, making=DAYS)
            frozen = freeze(out)
    say(
        f"Internal-Verified: {frozen.tasks} tasks, {frozen.unseen} in scenes that training never sees, {frozen.digest}"
    )
