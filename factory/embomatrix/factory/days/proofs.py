"""Proofs of an earlier build: tasks that differ from its tasks only in words need no new proof.

Poses and the proof in physics take 95 % of the CPU time of a day's build, and depend on scene, goals and tables only.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from embomatrix.factory.days.planning import PlannedDay
from embomatrix.factory.pipeline.settings import BuildSettings
from embomatrix.factory.pipeline.store import (
    Rejection,
    VariantResult,
    VariantYield,
    build_results,
    build_settings,
)
from embomatrix.factory.pipeline.variants import VariantOrder
from embomatrix.starter.archive import read_packed
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle
from embomatrix.world.dataset import Dataset, DatasetError, TaskRecord
from embomatrix.world.inflation import BundleError, bundle_digest
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task

PROVING: Final = ("physical", "reachability", "shortcut_plans")
"""Settings of a build that decide which drafts it admits."""


class DayProofs:
    """Days of an earlier build, by the names of their scenes."""

    _bundle: Callable[[str], Bundle]
    _settings: Mapping[str, Any]

    def __init__(self, path: Path) -> None:
        """Read the records of a build, or of a packed one. Raises DatasetError or OSError."""
        self._path = path
        records: Sequence[TaskRecord]
        self._refused: dict[str, tuple[Rejection, ...]] = {}
        if path.is_file():
            records, bundles, _ = read_packed(path)
            self._bundle = lambda digest: decode_bundle(bundles[digest])
            # Only `factory corpus` packs, and its recipes prove with the default settings. The file lacks the refusals.
            self._settings = dataclasses.asdict(BuildSettings())
        else:
            dataset = Dataset.load(path)
            records, self._bundle = dataset.records, dataset.read_bundle
            self._settings = build_settings(path)
            # The records name the scene that was laid out, the refusals only the day.
            self._refused = {
                record.task.scene_id: result.rejections
                for result in build_results(path)
                for record in result.records
            }
        self._days: dict[str, list[TaskRecord]] = {}
        for record in records:
            self._days.setdefault(record.task.scene_id, []).append(record)

    def check(self, settings: BuildSettings) -> None:
        """Raise DatasetError if the tasks were proved under other settings than these."""
        for name in PROVING:
            found, expected = self._settings.get(name), getattr(settings, name)
            if found != expected:
                raise DatasetError(
                    f"the tasks of {self._path} were proved with the setting {name} {found}, expected {expected}: name a "
                    "build with the same settings, or build without proofs"
                )

    def _bundle_of(self, digest: str) -> Bundle:
        try:
            return self._bundle(digest)
        except BundleError as error:
            raise DatasetError(f"the earlier build is damaged: {error}") from error

    def retold(self, planned: PlannedDay, order: VariantOrder) -> VariantYield | None:
        """Return the earlier day with the words of the planned one; None if more than the words differs.

        Its tasks, their plans and its refusals are the earlier ones; what was refused then is not tried again. Raises
        DatasetError for a damaged bundle.
        """
        known = self._days.get(planned.scene.scene_id, [])
        drafts = {draft.task.task_id: draft for draft in planned.drafts}
        if not known or any(record.task.task_id not in drafts for record in known):
            return None
        if any(
            _without_words(record.task) != _without_words(drafts[record.task.task_id].task)
            for record in known
        ):
            return None
        bundle = self._bundle_of(known[0].bundle_digest)
        if _content(bundle.scene) != _content(planned.scene):
            return None
        tasks = {record.task.task_id: drafts[record.task.task_id].task for record in known}
        data = encode_bundle(Bundle(planned.scene, tasks, bundle.poses, bundle.prepared))
        digest = bundle_digest(data)
        records = tuple(
            dataclasses.replace(
                record, task=tasks[record.task.task_id], bundle_digest=digest, difficulty=None
            )
            for record in known
        )
        transcripts = {name: drafts[name].transcript for name in tasks}
        result = VariantResult(order.split, order.number, records, self._refusals(planned))
        return VariantYield(result, data, transcripts, retold=True)

    def _refusals(self, planned: PlannedDay) -> tuple[Rejection, ...]:
        """Return the earlier refusals of the day, as far as they are known, with the words of the planned one."""
        words = {draft.task.goal_bddl: draft.task.instruction for draft in planned.drafts}
        return tuple(
            dataclasses.replace(each, instruction=words.get(each.goal, each.instruction))
            for each in self._refused.get(planned.scene.scene_id, ())
        )


def _without_words(task: Task) -> Task:
    return dataclasses.replace(task, instruction="")


def _content(scene: Scene) -> bytes:
    return encode_bundle(Bundle(scene, {}))
