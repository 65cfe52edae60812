"""``embomatrix factory corpus``: build training and held-out tasks and the frozen benchmark Internal-Verified 2."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.build import make_dataset
from embomatrix.factory.commands.difficulty import measured_records
from embomatrix.factory.commands.options import Jobs, LookAhead, Physical, in_physics
from embomatrix.factory.commands.terminal import say, user_errors
from embomatrix.factory.days.maker import DAYS
from embomatrix.factory.pipeline.corpus import (
    HELDOUT_SCENES,
    STARTER,
    TASKS,
    CorpusSettings,
    check_free,
    check_frozen,
    freeze,
    join_parts,
    part_folder,
)
from embomatrix.starter.archive import unpack
from embomatrix.world.dataset import Dataset


def corpus(
    out: Annotated[Path, typer.Option(help="Folder for the corpus.")] = Path("build/corpus"),
    train: Annotated[
        int, typer.Option(min=0, help="Number of training tasks, the shipped ones included.")
    ] = 2_000,
    heldout: Annotated[
        int, typer.Option(min=0, help="Number of held-out tasks, the shipped ones included.")
    ] = 200,
    verified: Annotated[
        int, typer.Option(min=1, help="Number of tasks of Internal-Verified 2: the hardest held-out ones.")
    ] = 100,
    scenes: Annotated[
        list[str] | None,
        typer.Option(
            help="Scene for added training tasks. Repeat the option for more scenes. Default: all that no other task is in."
        ),
    ] = None,
    unseen: Annotated[
        list[str] | None, typer.Option(help="Scene for added held-out tasks. Default: six scenes.")
    ] = None,
    jobs: Jobs = None,
    look_ahead: LookAhead = True,
    physical: Physical = None,
    check: Annotated[
        bool,
        typer.Option("--check", help="Build nothing; check that the corpus still has its frozen digest."),
    ] = False,
) -> None:
    """Build the corpus, or resume an interrupted build, and freeze its hardest held-out tasks.

    The shipped dataset is its first part.
    """
    with user_errors(out):
        if check:
            frozen = check_frozen(out)
        else:
            settings = CorpusSettings(
                train,
                heldout,
                tuple(scenes or ()),
                tuple(unseen or HELDOUT_SCENES),
                look_ahead,
                in_physics(physical, look_ahead=look_ahead),
            )
            check_free(out)
            unpack(part_folder(out, STARTER))
            starter = Dataset.load(part_folder(out, STARTER))
            builds = settings.builds(starter)
            for part, build in builds.items():
                make_dataset(part_folder(out, part), build, jobs=jobs, making=DAYS)
            joined = join_parts(out, (STARTER, *builds))
            say(
                f"{len(joined.records)} tasks in {out / TASKS}; {joined.dropped} left out as too like a held-out one"
            )
            dataset = Dataset.load(out / TASKS)
            frozen = freeze(out, measured_records(dataset, jobs), verified)
    say(f"Internal-Verified 2: {frozen.tasks} tasks in {len(frozen.scenes)} scenes, {frozen.digest}")
