"""Tasks as a writer makes them, before anybody verified them: what evaluations of diversity compare writers by."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.writer.tasks import Draft, DraftOrder
from embomatrix.factory.writer.variant import build_variant
from embomatrix.world.task import TaskCategory

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.factory.writer.tasks import TaskWriter
    from embomatrix.world.dataset import TaskRecord
    from embomatrix.world.scene import Scene

ROOMS: Final = 3
"""Rooms that a variant furnishes with small things, as in a build."""
EACH_VARIANT: Final = 5
TRIES: Final = 6
"""Attempts at a task, for each one that a variant is to give."""
MOST_VARIANTS: Final = 12
"""Variants of a scene that are looked at: some rooms hold nothing to ask for."""


@dataclass(frozen=True, slots=True)
class DraftFeatures:
    """What is measured of one task: its words, its goal's kind, its rooms, and whether its goal means any of several things."""

    instruction: str
    signature: str
    rooms: tuple[str, ...]
    quantified: bool


def asked_in(base: Scene, writer: TaskWriter, count: int, seed: int) -> list[DraftFeatures]:
    """So many different tasks over variants of a base scene, the categories in turns; fewer where it holds no more."""
    found: dict[str, DraftFeatures] = {}
    for number in range(MOST_VARIANTS):
        for draft in _drafts(base, writer, number, seed):
            found.setdefault(f"{draft.signature}|{draft.task.instruction}", _asked(draft))
            if len(found) == count:
                return list(found.values())
    return list(found.values())


def _drafts(base: Scene, writer: TaskWriter, number: int, seed: int) -> Iterator[Draft]:
    sequence = np.random.SeedSequence((seed, zlib.crc32(base.base.encode()), number))
    rng = np.random.default_rng(sequence)
    rooms = [str(name) for name in rng.permutation([room.name for room in base.rooms])[:ROOMS]]
    variant = build_variant(base, rooms, f"{base.base}-drafts-{number:02d}", rng)
    view, categories, given = SceneView(variant.scene), [*TaskCategory], 0
    for attempt in range(TRIES * EACH_VARIANT):
        category = categories[(number + attempt) % len(categories)]
        draft = writer.write(
            variant, view, DraftOrder(category, f"{variant.scene.scene_id}-{attempt:02d}", rng)
        )
        if isinstance(draft, Draft):
            yield draft
            given += 1
        if given == EACH_VARIANT:
            return


def _asked(draft: Draft) -> DraftFeatures:
    return DraftFeatures(draft.task.instruction, draft.signature, draft.rooms, bool(draft.task.types))


def asked_of(records: Sequence[TaskRecord], count: int) -> dict[str, list[DraftFeatures]]:
    """The first so many tasks of a dataset in each base scene that has as many, by base scene."""
    groups: dict[str, list[DraftFeatures]] = {}
    for record in records:
        base = record.task.scene_id.split("-")[0]
        asked = DraftFeatures(
            record.task.instruction, record.signature, record.rooms, bool(record.task.types)
        )
        groups.setdefault(base, []).append(asked)
    return {base: group[:count] for base, group in groups.items() if len(group) >= count}
