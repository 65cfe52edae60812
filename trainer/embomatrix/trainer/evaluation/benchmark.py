"""Benchmarks: tasks of a dataset or of a file, identified by a digest."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

from embomatrix.starter.shipped import FROZEN, STARTER, frozen_dataset, unpacked_tasks
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import TrainingTask, read_tasks
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, TaskRecord, record_to_json
from embomatrix.world.json_text import parse_json
from embomatrix.world.scene import Scene
from embomatrix.world.task import Profile

ALL: Final = "all"
IMPORT_REPORT: Final = "import.json"
"""Report of `embomatrix factory import --report` in the dataset's folder. Rejected problems count as failed."""
NAMED: Final[Mapping[str, tuple[Path, str]]] = {
    "eai": (Path("build/eai"), "embomatrix factory import"),
}
"""Benchmarks that a command creates, with their folders."""


@dataclass(frozen=True)
class Benchmark:
    """Tasks in the order of their file. ``failed_by_rule``: tasks that were rejected or that the skills can't express.

    These count as failures in the success over all tasks, and are left out of all other figures. ``file_records`` are all
    records of the file.
    """

    name: str
    folder: Path
    split: str
    records: tuple[TaskRecord, ...]
    failed_by_rule: frozenset[str] = frozenset()
    file_records: tuple[TaskRecord, ...] = ()

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the tasks, goals, tables and scenes. Equal benchmarks have equal digests in any folder.

        Measured difficulties are not part of it.
        """
        content = hashlib.sha256()
        for record in self.records:
            measured = replace(record, difficulty=None)
            content.update(json.dumps(record_to_json(measured), sort_keys=True).encode())
        for task_id in sorted(self.failed_by_rule):
            content.update(task_id.encode())
        return f"sha256:{content.hexdigest()}"

    @cached_property
    def dataset(self) -> Dataset:
        """Dataset with the bundles."""
        return Dataset(self.folder, self.records)

    @property
    def training(self) -> Dataset:
        """Dataset whose training split scripts learn from."""
        return Dataset(self.folder, self.file_records)

    @cached_property
    def tasks(self) -> Mapping[str, TrainingTask]:
        """Tasks with the content of their prompts, by id. Raises TrainerError if a bundle is missing."""
        found = read_tasks(self.dataset)
        return {record.task.task_id: found[record.task.task_id] for record in self.records}

    def scene(self, record: TaskRecord) -> Scene:
        """Return a task's scene. Raises TrainerError."""
        try:
            return self.dataset.read_bundle(record.bundle_digest).scene
        except DatasetError as error:
            raise TrainerError(str(error)) from error


def find_benchmark(
    named: str, split: str = "", limit: int | None = None, profile: Profile = Profile.HOUSEHOLD
) -> Benchmark:
    """Find a benchmark by name, dataset folder, or a file of task records with its bundles beside it.

    ``split`` is a split of the dataset or "all". By default, held-out tasks are used if there are any, else all. ``limit``
    takes the first tasks only. With the profile ``PAPER``, tasks that need another household skill fail by rule. Raises
    TrainerError.
    """
    if named in FROZEN and not Path(named).exists():
        return _frozen(named, split, limit, profile)
    path = _path_of(named)
    if not path.exists():
        remedy = f"pass a dataset folder, its {TASKS_FILE}, or one of {', '.join((STARTER, *FROZEN, *NAMED))}"
        if named in NAMED:
            remedy = f"create it with `{NAMED[named][1]}`, or pass its folder"
        raise TrainerError(f"no benchmark at {path}: {remedy}")
    folder = path if path.is_dir() else path.parent
    records = _read_records(path)
    chosen, found_split = _select_split(records, split, path)
    return _within(Benchmark(named, folder, found_split, chosen, _rejected(folder), records), limit, profile)


def _path_of(named: str) -> Path:
    if named == STARTER and not Path(named).exists():
        try:
            return unpacked_tasks()
        except (DatasetError, OSError) as error:
            raise TrainerError(f"the starter dataset can't be unpacked: {error}") from error
    return NAMED[named][0] if named in NAMED else Path(named)


def _frozen(named: str, split: str, limit: int | None, profile: Profile) -> Benchmark:
    """Return frozen tasks. The training tasks are those that they were chosen from. Raises TrainerError."""
    try:
        dataset, records = frozen_dataset(named)
    except (DatasetError, OSError) as error:
        raise TrainerError(str(error)) from error
    chosen, found_split = _select_split(dataset.records, split, Path(named))
    return _within(
        Benchmark(named, dataset.folder, found_split, chosen, frozenset(), records), limit, profile
    )


def _within(bench: Benchmark, limit: int | None, profile: Profile) -> Benchmark:
    """Return the tasks that the profile's skills can solve; the others fail by rule. Raises TrainerError."""
    chosen = bench.records
    within = [record for record in chosen if record.task.profile in (Profile.PAPER, profile)]
    inexpressible = {record.task.task_id for record in chosen} - {record.task.task_id for record in within}
    if not within:
        raise TrainerError(
            f"no task of {bench.folder} can be solved with the skills of the profile {profile}: pass another --profile"
        )
    return replace(
        bench, records=tuple(within[:limit]), failed_by_rule=bench.failed_by_rule | frozenset(inexpressible)
    )


def _rejected(folder: Path) -> frozenset[str]:
    """Names of the problems that an import rejected."""
    path = folder / IMPORT_REPORT
    try:
        outcomes = parse_json(path.read_bytes())["outcomes"]
        return frozenset(str(outcome["name"]) for outcome in outcomes if outcome["reason"])
    except FileNotFoundError:
        return frozenset()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainerError(
            f"{path} is not an import report ({error!r}): create it again with `embomatrix factory import --report`"
        ) from error


def _read_records(path: Path) -> tuple[TaskRecord, ...]:
    """Read the records of a dataset folder, or of a file with any name whose bundles lie beside it."""
    try:
        found = Dataset.load(path) if path.is_dir() else Dataset.load_file(path)
    except DatasetError as error:
        raise TrainerError(str(error)) from error
    missing = [
        record for record in found.records if path.is_file() and not found.has_bundle(record.bundle_digest)
    ]
    if missing:
        record = missing[0]
        raise TrainerError(
            f"the task {record.task.task_id!r} of {path} is in the unknown scene {record.task.scene_id!r}: its bundle "
            f"{record.bundle_digest} is not in {path.parent / 'bundles'}; copy it there from the task's original dataset"
        )
    return found.records


def _select_split(
    records: tuple[TaskRecord, ...], split: str, path: Path
) -> tuple[tuple[TaskRecord, ...], str]:
    held_out = tuple(record for record in records if record.split == "heldout")
    split = split or ("heldout" if held_out else ALL)
    chosen = records if split == ALL else tuple(record for record in records if record.split == split)
    if not chosen:
        splits = ", ".join(sorted({record.split for record in records}))
        raise TrainerError(
            f"{path} has no tasks in the split {split!r}: it has {splits or 'no tasks'}; pass another --split"
        )
    return chosen, split
