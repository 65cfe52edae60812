"""Build of a dataset with progress bars and a summary, for the commands that write datasets."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from embomatrix.factory.commands.language_model import MODEL_ERRORS
from embomatrix.factory.commands.options import processes
from embomatrix.factory.commands.terminal import fail, progress, say, show_table, user_errors
from embomatrix.factory.layout.request import LayoutAgents
from embomatrix.factory.pipeline.build import BuildSummary, Making, VariantCheck, build_dataset
from embomatrix.factory.pipeline.settings import BuildSettings
from embomatrix.factory.writer.tasks import TaskWriter
from embomatrix.world.scene import Scene
from embomatrix.world.task import TaskCategory


def make_dataset(
    out: Path,
    settings: BuildSettings,
    writer: TaskWriter | None = None,
    jobs: int | None = None,
    check: VariantCheck | None = None,
    layout: LayoutAgents | None = None,
    making: Making | None = None,
    own: Mapping[str, Scene] = MappingProxyType({}),
) -> BuildSummary:
    """Build the dataset with progress bars, print a summary and return it. Exit if it has too few tasks."""
    kept = f": finished tasks are kept in {out}; run the same command again to resume"
    with user_errors(out, kept, MODEL_ERRORS), progress() as bars:
        tasks = {
            "heldout": bars.add_task("held-out tasks", total=settings.heldout),
            "train": bars.add_task("training tasks", total=settings.train),
        }
        summary = build_dataset(
            out,
            settings,
            lambda split, admitted: bars.update(tasks[split], completed=admitted),
            writer,
            processes(jobs),
            check,
            layout,
            making,
            own,
        )
    _print_summary(summary)
    say(f"dataset: {out}")
    for split, wanted in (("train", settings.train), ("heldout", settings.heldout)):
        if summary.total(split) < wanted:
            fail(
                f"only {summary.total(split)} of {wanted} {split} tasks were admitted: see {out}/attempts.jsonl, "
                "add scenes, or ask for fewer"
            )
    return summary


def _print_summary(summary: BuildSummary) -> None:
    splits = ("train", "heldout")
    show_table(
        ("category", "train", "held out"),
        [
            *(
                (category, *(summary.admitted.get((split, category), 0) for split in splits))
                for category in TaskCategory
            ),
            ("all", *map(summary.total, splits)),
        ],
    )
    show_table(
        ("scene", "train", "held out", "held-out rooms"),
        (
            (scene, *(summary.scenes.get((split, scene), 0) for split in splits), ", ".join(rooms))
            for scene, rooms in summary.rooms["heldout"].items()
        ),
    )
    refused = ", ".join(f"{count} {reason}" for reason, count in sorted(summary.rejected.items())) or "none"
    say(f"{summary.variants} scene variants; drafts not admitted: {refused}")
