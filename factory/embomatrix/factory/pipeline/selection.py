"""Selections: tasks of one dataset as a dataset of their own, with their transcripts and layout trees."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from embomatrix.factory.pipeline.merge import MERGED_FILE, copy_texts
from embomatrix.factory.pipeline.store import (
    ATTEMPTS_FILE,
    BUILD_FILE,
    TIMES_FILE,
    TRANSCRIPTS_FOLDER,
    TREES_FOLDER,
)
from embomatrix.world.dataset import BUNDLES_FOLDER, TASKS_FILE, Dataset, TaskRecord, write_dataset

KNOWN_FILES: Final = (
    TASKS_FILE,  # first: a folder without records holds no dataset
    BUILD_FILE,
    ATTEMPTS_FILE,
    TIMES_FILE,
    MERGED_FILE,
    f"{BUNDLES_FOLDER}/*.bundle",
    f"{TRANSCRIPTS_FOLDER}/*.md",
    f"{TREES_FOLDER}/*.json",
)
"""Files of a dataset's folder that a selection replaces."""


def write_selection(out: Path, dataset: Dataset, records: Sequence[TaskRecord]) -> None:
    """Write records of a dataset to another folder, in the place of a dataset there. Raises DatasetError or OSError."""
    bundles = {
        digest: dataset.bundle_bytes(digest)
        for digest in dict.fromkeys(record.bundle_digest for record in records)
    }
    if (out / TASKS_FILE).exists():
        for pattern in KNOWN_FILES:
            for file in sorted(out.glob(pattern)):
                file.unlink()
    out.mkdir(parents=True, exist_ok=True)
    for record in records:
        copy_texts(dataset.folder, out, record.task.task_id)
    write_dataset(out, records, bundles)
