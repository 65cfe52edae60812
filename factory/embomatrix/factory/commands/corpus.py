"""``embomatrix factory corpus``: build a training set, a held-out set and the frozen benchmark Internal-Verified 2."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.build import make_dataset
from embomatrix.factory.commands.difficulty import script_results
from embomatrix.factory.commands.options import Jobs, LookAhead, Physical, Seed, in_physics
from embomatrix.factory.commands.terminal import say, user_errors
from embomatrix.factory.days.maker import DAYS
from embomatrix.factory.evaluate.difficulty import with_scripts
from embomatrix.factory.pipeline.corpus import (
    HELDOUT_SCENES,
    TRAIN,
    CorpusSettings,
    Frozen,
    check_frozen,
    freeze,
    gather_heldout,
)
from embomatrix.world.dataset import Dataset


def corpus(
    out: Annotated[Path, typer.Option(help="Folder for the corpus.")] = Path("build/corpus"),
    train: Annotated[int, typer.Option(min=0, help="Number of training tasks.")] = 2_000,
    heldout: Annotated[int, typer.Option(min=2, help="Number of held-out tasks.")] = 200,
    verified: Annotated[
        int, typer.Option(min=1, help="Number of tasks of Internal-Verified 2: the hardest held-out ones.")
    ] = 100,
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
    """Build the corpus, or resume an interrupted build, and freeze its hardest held-out tasks."""
    with user_errors(out):
        if check:
            frozen = check_frozen(out)
        else:
            settings = CorpusSettings(
                train,
                heldout,
                verified,
                seed,
                tuple(scenes or ()),
                tuple(unseen or HELDOUT_SCENES),
                look_ahead,
                in_physics(physical, look_ahead=look_ahead),
            )
            for name, build in settings.builds().items():
                make_dataset(out / name, build, jobs=jobs, making=DAYS)
            frozen = _frozen(out, verified, jobs)
    say(
        f"Internal-Verified 2: {frozen.tasks} tasks, {frozen.unseen} in scenes that training never sees, {frozen.digest}"
    )


def _frozen(folder: Path, verified: int, jobs: int | None) -> Frozen:
    """Measure the held-out tasks by scripts that know the training tasks, and freeze the hardest."""
    heldout = gather_heldout(folder)
    results = script_results(heldout, heldout.records, Dataset.load(folder / TRAIN), jobs)
    return freeze(folder, with_scripts(heldout.records, results), verified)
