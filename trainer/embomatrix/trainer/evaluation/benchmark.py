"""What is measured: tasks of a dataset or of a file, and a digest that names exactly these."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import training_task
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, record_to_json
from embomatrix.world.task import Profile

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.world.dataset import TaskRecord
    from embomatrix.world.scene import Scene

ALL: Final = "all"
IMPORT_REPORT: Final = "import.json"
"""What `embomatrix factory import --report` wrote, in the dataset's folder: problems that were refused count as failed."""
NAMED: Final[Mapping[str, Path]] = {
    "internal-verified": Path("build/internal-verified"),
    "eai": Path("build/eai"),
}
"""Benchmarks that go by a name, and the dataset folders in which they lie."""
_BUILD_IT: Final[Mapping[str, str]] = {
    "internal-verified": "freeze one with `embomatrix factory`, or pass its folder",
    "eai": "make it with `embomatrix factory import`, or pass its folder",
}


@dataclass(frozen=True)
class Benchmark:
    """Tasks in the order of their file. ``failed_by_rule`` are those that were refused or that no skill reaches.

    Those count as failures in the success over all tasks, and not at all in the other figures.
    """

    name: str
    folder: Path
    split: str
    records: tuple[TaskRecord, ...]
    failed_by_rule: frozenset[str] = frozenset()

    @cached_property
    def digest(self) -> str:
        """SHA-256 over the tasks, their goals, tables and scenes: equal benchmarks have equal ones wherever they lie."""
        content = hashlib.sha256()
        for record in self.records:
            content.update(json.dumps(record_to_json(record), sort_keys=True).encode())
        for task_id in sorted(self.failed_by_rule):
            content.update(task_id.encode())
        return f"sha256:{content.hexdigest()}"

    @cached_property
    def dataset(self) -> Dataset:
        """Where the bundles are."""
        return Dataset(self.folder, self.records)

    @cached_property
    def tasks(self) -> Mapping[str, TrainingTask]:
        """The tasks with what a prompt tells of them, by their ids. Raises TrainerError where a bundle is missing."""
        found: dict[str, TrainingTask] = {}
        by_bundle: dict[str, list[TaskRecord]] = {}
        for record in self.records:
            by_bundle.setdefault(record.bundle_digest, []).append(record)
        try:
            for digest, records in by_bundle.items():
                bundle = self.dataset.read_bundle(digest)
                found |= {record.task.task_id: training_task(bundle, record) for record in records}
        except DatasetError as error:
            raise TrainerError(str(error)) from error
        return {record.task.task_id: found[record.task.task_id] for record in self.records}

    def scene(self, record: TaskRecord) -> Scene:
        """The scene of a task. Raises TrainerError."""
        try:
            return self.dataset.read_bundle(record.bundle_digest).scene
        except DatasetError as error:
            raise TrainerError(str(error)) from error


def find_benchmark(
    named: str, split: str = "", limit: int | None = None, profile: Profile = Profile.HOUSEHOLD
) -> Benchmark:
    """A benchmark by its name, its dataset folder, or a file of task records with its bundles beside it.

    ``split`` is one of the dataset's or "all"; empty takes the held-out tasks where there are any, else all. ``limit`` takes
    the first so many. With the profile ``PAPER``, tasks that need one of the household's three skills more are failed by rule.
    Raises TrainerError.
    """
    path = NAMED.get(named, Path(named))
    if path.is_file():
        records = _of_file(path)
        folder = path.parent
    elif path.is_dir():
        records, folder = _of_folder(path), path
    else:
        remedy = _BUILD_IT.get(
            named, f"pass a dataset folder, its {TASKS_FILE}, or one of {', '.join(NAMED)}"
        )
        raise TrainerError(f"there is no benchmark at {path}: {remedy}")
    chosen, told = _of_split(records, split, path)
    within = [record for record in chosen if record.task.profile in (Profile.PAPER, profile)]
    beyond = {record.task.task_id for record in chosen} - {record.task.task_id for record in within}
    if not within:
        raise TrainerError(
            f"no task of {path} can be done with the skills of the profile {profile}: pass another --profile"
        )
    return Benchmark(named, folder, told, tuple(within[:limit]), frozenset(beyond | _refused(folder)))


def _refused(folder: Path) -> set[str]:
    """Names of the problems that an import refused."""
    path = folder / IMPORT_REPORT
    try:
        outcomes = json.loads(path.read_bytes())["outcomes"]
        return {str(outcome["name"]) for outcome in outcomes if outcome["reason"]}
    except FileNotFoundError:
        return set()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainerError(
            f"{path} is no report of an import ({error!r}): write it again with `embomatrix factory import --report`"
        ) from error


def _of_folder(folder: Path) -> tuple[TaskRecord, ...]:
    try:
        return Dataset.load(folder).records
    except DatasetError as error:
        raise TrainerError(str(error)) from error


def _of_file(path: Path) -> tuple[TaskRecord, ...]:
    """Records of a file that may have any name; their scenes must be among the bundles beside it."""
    try:
        found = Dataset.load_file(path)
    except DatasetError as error:
        raise TrainerError(str(error)) from error
    for record in found.records:
        if not found.has_bundle(record.bundle_digest):
            raise TrainerError(
                f"the task {record.task.task_id!r} of {path} is in the unknown scene {record.task.scene_id!r}: its bundle "
                f"{record.bundle_digest} is not in {path.parent / 'bundles'}; copy it there from the dataset that the task "
                "was made for"
            )
    return found.records


def _of_split(records: tuple[TaskRecord, ...], split: str, path: Path) -> tuple[tuple[TaskRecord, ...], str]:
    held_out = tuple(record for record in records if record.split == "heldout")
    told = split or ("heldout" if held_out else ALL)
    chosen = records if told == ALL else tuple(record for record in records if record.split == told)
    if not chosen:
        splits = ", ".join(sorted({record.split for record in records}))
        raise TrainerError(
            f"{path} has no tasks of the split {told!r}: it has {f'those of {splits}' if splits else 'no task at all'}"
        )
    return chosen, told
