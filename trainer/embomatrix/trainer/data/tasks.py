"""Training tasks and their order: seeded, different in each epoch, known arbitrarily far ahead."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from embomatrix.skills.parse import PlanError, plan_from_json
from embomatrix.skills.prompt import Situation, situation_of
from embomatrix.skills.syntax import Plan
from embomatrix.starter.shipped import open_dataset
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.world.asset import Asset
from embomatrix.world.bundle import Bundle
from embomatrix.world.dataset import Dataset, DatasetError, TaskRecord
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task


@dataclass(frozen=True, slots=True)
class TrainingTask:
    """Task with the content of its prompt, the digest of its bundle, and the oracle plan."""

    task: Task
    situation: Situation
    bundle_digest: str
    oracle: Plan


@dataclass(frozen=True)
class TaskSet:
    """Training and held-out tasks. ``bundle_bytes`` returns a bundle by its digest.

    ``kinds`` maps a category to all categories of the same kind, which have the same abilities. ``folder`` is the dataset's.
    """

    train: tuple[TrainingTask, ...]
    heldout: tuple[TrainingTask, ...]
    bundle_bytes: Callable[[str], bytes] = field(repr=False)
    kinds: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    folder: Path | None = None


def load_tasks(folder: Path) -> TaskSet:
    """Load a dataset folder, or a shipped one by its name. Raises TrainerError if it is missing or damaged."""
    kinds = KindTable()
    try:
        dataset = open_dataset(folder)
    except (DatasetError, OSError) as error:
        raise TrainerError(str(error)) from error
    tasks = read_tasks(dataset, kinds.add)
    train = tuple(tasks[record.task.task_id] for record in dataset.train)
    if not train:
        raise TrainerError(f"the dataset at {folder} has no training tasks: build it again with more tasks")
    heldout = tuple(tasks[record.task.task_id] for record in dataset.heldout)
    return TaskSet(train, heldout, dataset.bundle_bytes, kinds.table(), folder)


def read_tasks(
    dataset: Dataset, on_scene: Callable[[Scene], None] = lambda _: None
) -> dict[str, TrainingTask]:
    """Read all tasks of a dataset by id. ``on_scene`` gets each scene once. Raises TrainerError."""
    by_bundle: dict[str, list[TaskRecord]] = {}
    for record in dataset.records:
        by_bundle.setdefault(record.bundle_digest, []).append(record)
    tasks: dict[str, TrainingTask] = {}
    for digest, records in by_bundle.items():
        try:
            # One scene at a time: decoding all of them would use the memory that simulators need.
            bundle = dataset.read_bundle(digest)
        except DatasetError as error:
            raise TrainerError(str(error)) from error
        on_scene(bundle.scene)
        tasks |= {record.task.task_id: training_task(bundle, record) for record in records}
    return tasks


_KIND_ABILITIES: Final = ("toggleable", "heatSource", "coldSource", "cookable", "freezable")
"""Abilities that decide which skills apply to an object."""


class KindTable:
    """Groups categories that a plan treats alike: same abilities, doors, cavities and surfaces, and all fixed or all loose."""

    def __init__(self) -> None:
        self._kinds: dict[str, set[tuple[object, ...]]] = {}

    def add(self, scene: Scene) -> None:
        for item in scene.objects:
            asset = scene.assets[item.asset_id]
            self._kinds.setdefault(asset.category, set()).add(_kind(asset, fixed=item.fixed))

    def table(self) -> dict[str, tuple[str, ...]]:
        """Map each category to all of its kind. Categories that occur as two kinds (a fixed and a loose chair) are left out."""
        members: dict[tuple[object, ...], list[str]] = {}
        for category, kinds in self._kinds.items():
            if len(kinds) == 1:
                members.setdefault(next(iter(kinds)), []).append(category)
        return {category: tuple(alike) for alike in members.values() for category in alike}


def _kind(asset: Asset, *, fixed: bool) -> tuple[object, ...]:
    abilities = tuple(asset.can(ability) for ability in _KIND_ABILITIES)
    return (fixed, bool(asset.joints), bool(asset.interiors), bool(asset.supports), abilities)


def training_task(bundle: Bundle, record: TaskRecord) -> TrainingTask:
    """Build the training task of a record. Raises TrainerError if record and bundle disagree."""
    task = record.task
    if bundle.tasks.get(task.task_id) != task:
        raise TrainerError(
            f"the dataset's task {task.task_id!r} differs from the task of that name in its bundle {record.bundle_digest}: "
            "build the dataset again"
        )
    try:
        oracle = plan_from_json(list(record.oracle), task.profile) if record.oracle else ()
    except PlanError as error:
        raise TrainerError(
            f"the oracle plan of the dataset's task {task.task_id!r} is damaged ({error}): build the dataset again"
        ) from error
    return TrainingTask(task, situation_of(bundle.scene, task), record.bundle_digest, oracle)


UNKNOWN_LENGTH: Final = 10_000
"""Sort key for tasks without an oracle plan: they come last."""


@dataclass(frozen=True, slots=True)
class Curriculum:
    """Pool of tasks that grows linearly from the ``start`` share to all tasks over the first ``tasks`` draws."""

    tasks: int = 0
    start: float = 1.0

    def pool(self, position: int, count: int) -> int:
        """Size of the pool out of ``count`` tasks at this draw."""
        share = self.start + (1.0 - self.start) * min(1.0, position / self.tasks)
        return max(1, min(count, round(share * count)))


SCENES_AT_ONCE: Final = 32
"""Scenes whose tasks are shuffled together. A worker that keeps its share of them loads each scene once an epoch."""


class Schedule:
    """Endless order of tasks. ``cursor`` is its whole state: equal seeds and cursors give equal futures.

    Each epoch contains every task once: scenes come in random order, and the tasks of ``SCENES_AT_ONCE`` scenes are
    shuffled together. With a ``curriculum``, the first draws come from a pool that starts with the shortest oracle plans.
    ``stream`` separates schedules with the same seed.
    """

    def __init__(
        self,
        tasks: Sequence[TrainingTask],
        *,
        seed: int,
        cursor: int = 0,
        stream: int = 0,
        curriculum: Curriculum | None = None,
    ) -> None:
        self._tasks = tuple(tasks)
        self._seed = (seed, stream)
        self._curriculum = curriculum or Curriculum()
        self._by_length = sorted(
            self._tasks, key=lambda task: (len(task.oracle) or UNKNOWN_LENGTH, task.task.task_id)
        )
        by_scene: dict[str, list[TrainingTask]] = {}
        for task in self._tasks:
            by_scene.setdefault(task.bundle_digest, []).append(task)
        self._scenes = tuple(by_scene.values())
        self._epoch: tuple[int, list[TrainingTask]] = (-1, [])
        self.cursor = cursor

    def take(self, count: int) -> tuple[TrainingTask, ...]:
        """Return the next tasks and advance the cursor."""
        taken = self.peek(count)
        self.cursor += count
        return taken

    def peek(self, count: int, *, skip: int = 0) -> tuple[TrainingTask, ...]:
        """Return the tasks that ``take`` would return after skipping ``skip`` others."""
        begin = self.cursor + skip
        return tuple(self._at(position) for position in range(begin, begin + count))

    def _at(self, position: int) -> TrainingTask:
        if position < self._curriculum.tasks:
            pool = self._curriculum.pool(position, len(self._tasks))
            draw = np.random.default_rng(np.random.SeedSequence((*self._seed, 1, position)))
            return self._by_length[int(draw.integers(pool))]
        epoch, offset = divmod(position, len(self._tasks))
        if self._epoch[0] != epoch:
            self._epoch = (epoch, self._order(epoch))
        return self._epoch[1][offset]

    def _order(self, epoch: int) -> list[TrainingTask]:
        random = np.random.default_rng(np.random.SeedSequence((*self._seed, 0, epoch)))
        scenes = random.permutation(len(self._scenes))
        order: list[TrainingTask] = []
        for begin in range(0, len(scenes), SCENES_AT_ONCE):
            together = [
                task for scene in scenes[begin : begin + SCENES_AT_ONCE] for task in self._scenes[scene]
            ]
            order.extend(together[place] for place in random.permutation(len(together)))
        return order
