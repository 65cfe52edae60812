"""Merge of datasets: one folder with the tasks of several, whose held-out tasks stay unseen in training."""

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from hashlib import sha256
from pathlib import Path
from typing import Final

from embomatrix.factory.pipeline.store import TRANSCRIPTS_FOLDER, TREES_FOLDER
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.world.dataset import (
    BUNDLES_FOLDER,
    TASKS_FILE,
    Dataset,
    DatasetError,
    TaskRecord,
    bundle_file,
    record_to_json,
    write_dataset,
)
from embomatrix.world.inflation import bundle_digest
from embomatrix.world.whole_file import read_whole, write_whole

MERGED_FILE: Final = "merged.json"
"""File of a merged dataset that lists its sources."""
MAX_TEXT_BYTES: Final = 16 * 1024 * 1024
"""Size limit of a transcript or of a layout tree."""
MAX_SHOWN: Final = 8
"""Maximum number of conflicts in an error message."""


class Resolution(StrEnum):
    """Treatment of training tasks that give away held-out tasks of another dataset."""

    REFUSE = "refuse"  # nothing is written
    DROP_TRAIN = "drop-train"  # the training tasks are left out
    DROP_HELDOUT = "drop-heldout"  # the held-out tasks are left out


class ConflictKind(StrEnum):
    """Content that a training task shares with a held-out task of another dataset."""

    TASK = "task"
    SIGNATURE = "signature in the scene"
    INSTRUCTION = "instruction"
    ROOM = "room of the scene"


@dataclass(frozen=True, slots=True)
class SplitConflict:
    """Training task and held-out task of another dataset that share ``value``."""

    kind: ConflictKind
    value: str
    train: TaskRecord
    heldout: TaskRecord


@dataclass(frozen=True, slots=True)
class MergeSource:
    """Dataset that was merged. ``digest`` is the SHA-256 of its records."""

    name: str
    tasks: int
    digest: str


@dataclass(frozen=True, slots=True)
class MergeSummary:
    """Result of a merge, with the number of tasks that were left out."""

    records: tuple[TaskRecord, ...]
    duplicates: int
    conflicts: tuple[SplitConflict, ...]
    dropped: int


@dataclass(frozen=True, slots=True)
class SourcedRecord:
    """Record with the number of its dataset."""

    source: int
    record: TaskRecord


def merge_datasets(
    folders: Sequence[Path], out: Path, resolution: Resolution = Resolution.REFUSE
) -> MergeSummary:
    """Write the tasks of all datasets into a new folder.

    Exact duplicates are dropped. If only one of two has a measured difficulty, that is kept. Raise DatasetError if two tasks
    differ and have one id, if a training task gives a held-out task of another dataset away and ``resolution`` says to
    refuse, or if the folder is not empty; OSError.
    """
    if out.exists() and any(out.iterdir()):
        raise DatasetError(f"{out} is not empty: a merge overwrites nothing; name another folder with --out")
    datasets = [Dataset.load(folder) for folder in folders]
    members = _distinct(datasets)
    conflicts = tuple(split_conflicts(members))
    if conflicts and resolution is Resolution.REFUSE:
        raise DatasetError(_in_words(conflicts))
    lost = {id(each.train if resolution is Resolution.DROP_TRAIN else each.heldout) for each in conflicts}
    kept = [each for each in members if id(each.record) not in lost]
    if not kept:
        raise DatasetError(
            f"{resolution.value} leaves no task: each one shares something with another dataset"
        )
    _write(out, datasets, kept)
    total = sum(len(dataset.records) for dataset in datasets)
    records = tuple(each.record for each in kept)
    return MergeSummary(records, total - len(members), conflicts, len(members) - len(kept))


def _distinct(datasets: Sequence[Dataset]) -> list[SourcedRecord]:
    """Return the records without exact duplicates. Raise DatasetError if tasks of one id differ in more than their split.

    Difficulties are not compared: they are measured later, and depend on the training tasks.
    """
    members: list[SourcedRecord] = []
    known: defaultdict[str, list[int]] = defaultdict(list)
    for number, dataset in enumerate(datasets):
        for record in dataset.records:
            alike = known[record.task.task_id]
            same = next((at for at in alike if _unmeasured(members[at].record) == _unmeasured(record)), None)
            if same is not None:
                if members[same].record.difficulty is None:
                    members[same] = replace(members[same], record=record)
                continue
            for other in (members[at] for at in alike):
                if differing := _differences(other.record, record):
                    raise DatasetError(
                        f"two tasks have the id {record.task.task_id!r} and differ in {', '.join(differing)}: one in "
                        f"{datasets[other.source].folder}, one in {dataset.folder}; build one of them with another seed"
                    )
            alike.append(len(members))
            members.append(SourcedRecord(number, record))
    return members


def _unmeasured(record: TaskRecord) -> TaskRecord:
    return replace(record, difficulty=None)


def _differences(first: TaskRecord, second: TaskRecord) -> list[str]:
    """Return the fields in which two records of one id differ, without the split and the difficulty."""
    a, b = record_to_json(first), record_to_json(second)
    names = (a.keys() | b.keys()) - {"split", "difficulty"}
    return sorted(name for name in names if a.get(name) != b.get(name))


def split_conflicts(members: Sequence[SourcedRecord]) -> Iterator[SplitConflict]:
    """Yield each pair of a training task and a held-out task of another dataset for everything that they share."""
    held: defaultdict[tuple[ConflictKind, str], list[SourcedRecord]] = defaultdict(list)
    for each in members:
        if each.record.split == "heldout":
            for trait in _traits(each.record):
                held[trait].append(each)
    for each in members:
        if each.record.split != "train":
            continue
        for kind, value in _traits(each.record):
            for other in held.get((kind, value), ()):
                if other.source != each.source:
                    yield SplitConflict(kind, value, each.record, other.record)


def _traits(record: TaskRecord) -> list[tuple[ConflictKind, str]]:
    """Return everything that the other split of another dataset must not share, the strongest first."""
    base = base_scene_of(record.task.scene_id)
    words = " ".join("".join(c if c.isalnum() else " " for c in record.task.instruction.casefold()).split())
    return [
        (ConflictKind.TASK, record.task.task_id),
        *([(ConflictKind.SIGNATURE, f"{base}: {record.signature}")] if record.signature else []),
        (ConflictKind.INSTRUCTION, words),
        *((ConflictKind.ROOM, f"{base}: {room}") for room in record.rooms),
    ]


def _in_words(conflicts: Sequence[SplitConflict]) -> str:
    """Return the conflicts and the remedy as one message."""
    shown = "; ".join(
        f"{each.train.task.task_id!r} trains on the {each.kind} of {each.heldout.task.task_id!r} ({each.value})"
        for each in conflicts[:MAX_SHOWN]
    )
    counts = ", ".join(f"{count} by {kind}" for kind, count in conflict_counts(conflicts).items())
    return (
        f"training tasks give held-out tasks of another dataset away ({counts}): {shown}; leave one side out with "
        f"--resolve {Resolution.DROP_TRAIN} or --resolve {Resolution.DROP_HELDOUT}"
    )


def conflict_counts(conflicts: Iterable[SplitConflict]) -> Mapping[ConflictKind, int]:
    """Return the number of conflicts of each kind that occurs."""
    return Counter(each.kind for each in conflicts)


def _write(out: Path, datasets: Sequence[Dataset], members: Sequence[SourcedRecord]) -> None:
    """Copy bundles, transcripts and layout trees, then write the records."""
    (out / BUNDLES_FOLDER).mkdir(parents=True, exist_ok=True)
    for each in members:
        dataset, digest = datasets[each.source], each.record.bundle_digest
        path = out / BUNDLES_FOLDER / bundle_file(digest)
        if not path.exists():
            data = dataset.bundle_bytes(digest)
            if bundle_digest(data) != digest:
                raise DatasetError(
                    f"the bundle {path.name} of {dataset.folder} is damaged: found the digest {bundle_digest(data)}, "
                    f"expected {digest}; copy the dataset again"
                )
            write_whole(path, data)
        copy_texts(dataset.folder, out, each.record.task.task_id)
    sources = [asdict(_source_of(dataset)) for dataset in datasets]
    write_whole(out / MERGED_FILE, (json.dumps(sources, indent=1) + "\n").encode("ascii"))
    write_dataset(out, [each.record for each in members], {})


def copy_texts(folder: Path, out: Path, task_id: str) -> None:
    """Copy the task's transcript and layout tree, if there are any. An id that is a path has none."""
    for name, suffix in ((TRANSCRIPTS_FOLDER, "md"), (TREES_FOLDER, "json")):
        path = folder / name / f"{task_id}.{suffix}"
        if path.name == f"{task_id}.{suffix}" and path.is_file():
            (out / name).mkdir(exist_ok=True)
            write_whole(out / name / path.name, read_whole(path, at_most=MAX_TEXT_BYTES))


def _source_of(dataset: Dataset) -> MergeSource:
    data = (dataset.folder / TASKS_FILE).read_bytes()
    return MergeSource(
        dataset.folder.resolve().name, len(dataset.records), f"sha256:{sha256(data).hexdigest()}"
    )
