"""What benches run on: scenes of a dataset with the oracle plans of their tasks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from embomatrix.bench.report.figures import BenchError
from embomatrix.skills.parse import PlanError, plan_from_json

if TYPE_CHECKING:
    from embomatrix.skills.syntax import Plan
    from embomatrix.world.dataset import Dataset, TaskRecord


@dataclass(frozen=True, slots=True)
class Demonstration:
    """A task's id and the plan that reaches its goal."""

    task_id: str
    plan: Plan


@dataclass(frozen=True, slots=True)
class BenchScene:
    """A bundle as it lies on disk, and a plan for each of its tasks; at least one."""

    bundle_digest: str
    data: bytes
    demonstrations: tuple[Demonstration, ...]


def scenes_of(dataset: Dataset, count: int) -> tuple[BenchScene, ...]:
    """Up to ``count`` scenes, evenly spread over the dataset. Raises BenchError or DatasetError."""
    by_digest: dict[str, list[TaskRecord]] = {}
    for record in dataset.records:
        by_digest.setdefault(record.bundle_digest, []).append(record)
    if not by_digest:
        raise BenchError(
            f"the dataset in {dataset.folder} has no tasks: build one with 'embomatrix factory build'"
        )
    digests = list(by_digest)
    chosen = np.linspace(0, len(digests) - 1, min(count, len(digests))).round().astype(int)
    return tuple(
        BenchScene(
            digests[index],
            dataset.bundle_bytes(digests[index]),
            tuple(_demonstration(record) for record in by_digest[digests[index]]),
        )
        for index in chosen
    )


def _demonstration(record: TaskRecord) -> Demonstration:
    try:
        return Demonstration(record.task.task_id, plan_from_json([*record.oracle], record.task.profile))
    except PlanError as error:
        raise BenchError(
            f"the oracle plan of task {record.task.task_id!r} is no plan: {error}; build the dataset anew"
        ) from error
