"""Corpus: parts built by the recipes of ``embomatrix.starter``, joined, and the benchmark that is frozen from it."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from embomatrix.factory.pipeline.merge import MERGED_FILE, MergeSummary, Resolution, merge_datasets
from embomatrix.factory.pipeline.settings import BuildSettings, WriterKind
from embomatrix.factory.pipeline.store import BUILD_FILE
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.starter.archive import content_digest, read_packed
from embomatrix.starter.recipes import PARTS, SEED, Recipe
from embomatrix.starter.shipped import FrozenTasks, freeze
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, TaskRecord
from embomatrix.world.difficulty import DifficultyLevel, shuffle_key

PARTS_FOLDER: Final = "parts"
TASKS: Final = "tasks"
"""Folder of all tasks as one dataset."""


def settings_of(recipe: Recipe) -> BuildSettings:
    """Return the settings of a part's build."""
    return BuildSettings(recipe.train, recipe.heldout, SEED, recipe.scenes, WriterKind.SOCIAL)


def training_scenes() -> tuple[str, ...]:
    """Return all base scenes but those of the parts that only hold out."""
    unseen = {scene for recipe in PARTS.values() if not recipe.train for scene in recipe.scenes}
    return tuple(scene for scene in Catalog.load().scene_ids if scene not in unseen)


def part_folder(folder: Path, part: int) -> Path:
    """Return the folder of a part of the corpus."""
    return folder / PARTS_FOLDER / str(part)


def check_free(folder: Path) -> None:
    """Raise DatasetError if the folder for all tasks holds some that no earlier build of a corpus wrote."""
    path = folder / TASKS
    if path.exists() and not (path / MERGED_FILE).exists() and (not path.is_dir() or any(path.iterdir())):
        raise DatasetError(
            f"{path} was not written by `factory corpus`: name another folder with --out, or move it away"
        )


def join_parts(folder: Path, parts: Sequence[int]) -> MergeSummary:
    """Write the tasks of the parts as one dataset. A training task that gives a held-out one away is left out.

    An error leaves the tasks of an earlier call as they are. Raises DatasetError if a part is missing or a scene is on both
    sides, or OSError.
    """
    for part in parts:
        if not (part_folder(folder, part) / TASKS_FILE).exists():
            raise DatasetError(
                f"part {part} is not complete in {part_folder(folder, part)}: make it with "
                f"`embomatrix factory corpus --out {folder} --part {part}`"
            )
    fresh = folder / f"{TASKS}.partial"
    shutil.rmtree(fresh, ignore_errors=True)
    try:
        joined = merge_datasets([part_folder(folder, part) for part in parts], fresh, Resolution.DROP_TRAIN)
        _check_apart(joined.records)
        shutil.rmtree(folder / TASKS, ignore_errors=True)
        fresh.replace(folder / TASKS)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return joined


def is_finished(folder: Path) -> bool:
    """True if a folder holds a build that ran to its end; an interrupted one has a log and no tasks yet."""
    return (folder / BUILD_FILE).exists() and (folder / TASKS_FILE).exists()


def holds_build_of(folder: Path, archive: Path) -> bool:
    """True if a build gave the tasks of a shipped part, besides those that are left out of the corpus.

    Raises DatasetError or OSError.
    """
    records, _, expected = read_packed(archive)
    shipped = {record.task.task_id for record in records}
    built = Dataset.load(folder)
    found = tuple(record for record in built.records if record.task.task_id in shipped)
    return content_digest(Dataset(built.folder, found)) == expected


def joined_part(folder: Path, part: int) -> Dataset:
    """Return the tasks of one part in the joined dataset. Raises DatasetError."""
    own = {record.task.task_id for record in Dataset.load(part_folder(folder, part)).records}
    joined = Dataset.load(folder / TASKS)
    return Dataset(joined.folder, tuple(record for record in joined.records if record.task.task_id in own))


def freeze_hardest(records: Sequence[TaskRecord], count: int, file: Path) -> FrozenTasks:
    """Write the ids of the hardest ``count`` held-out tasks to a file, with the digest of their records.

    Raises DatasetError for fewer tasks, or OSError.
    """
    held_out = [record for record in records if record.split == "heldout"]
    if len(held_out) < count:
        raise DatasetError(f"found {len(held_out)} held-out tasks to freeze: expected at least {count}")
    return freeze(_hardest(held_out, count), file)


def _hardest(records: Sequence[TaskRecord], count: int) -> list[TaskRecord]:
    """Return the hardest records in their order: hard before medium before easy."""

    def rank(record: TaskRecord) -> tuple[int, bytes]:
        level = DifficultyLevel.EASY if record.difficulty is None else record.difficulty.level
        return -list(DifficultyLevel).index(level), shuffle_key(record.task.task_id)

    chosen = {record.task.task_id for record in sorted(records, key=rank)[:count]}
    return [record for record in records if record.task.task_id in chosen]


def _check_apart(records: Sequence[TaskRecord]) -> None:
    """Raise DatasetError if training and held-out tasks share an instruction or a scene."""
    train, heldout = (
        [record for record in records if record.split == split] for split in ("train", "heldout")
    )
    said = {record.task.instruction for record in train} & {record.task.instruction for record in heldout}
    if said:
        raise DatasetError(
            f"the instruction {min(said)!r} is trained on and held out: use one seed for all parts"
        )
    shared = {base_scene_of(record.task.scene_id) for record in train} & {
        base_scene_of(record.task.scene_id) for record in heldout
    }
    if shared:
        raise DatasetError(
            f"tasks in {min(shared)} are trained on and held out: give each part scenes of its own"
        )
