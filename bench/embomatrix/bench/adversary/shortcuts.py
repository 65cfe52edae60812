"""Search for plans that succeed although they violate the instruction, on tasks that the factory builds for the search."""

import math
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from embomatrix.factory.days.maker import DAYS
from embomatrix.factory.evaluate.faithfulness import PolicyAnswers, audit_dataset, evaluation_of
from embomatrix.factory.pipeline.build import build_dataset
from embomatrix.factory.pipeline.settings import BuildSettings, WriterKind
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.host.limits import usable_cores
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.dataset import Dataset


@dataclass(frozen=True, slots=True)
class HuntSizes:
    """``tasks`` of each writer, and the least number of plans for each base scene and writer.

    Random plans that repeat an earlier one count, and are not executed again: a little less than half of all.
    """

    tasks: int = 48
    plans: int = 12_000
    seed: int = 0


QUICK_HUNT: Final = HuntSizes(tasks=12, plans=400)


def hunt_shortcuts(sizes: HuntSizes, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Make tasks with both writers and search all of them. Raises DatasetError if a process dies."""
    audits, refused, jobs = [], 0, usable_cores()
    executed: Counter[str] = Counter()
    for writer in (WriterKind.PLAIN, WriterKind.SOCIAL):
        settings = BuildSettings(
            train=sizes.tasks,
            heldout=0,
            seed=sizes.seed,
            writer=writer,
            reachability=False,
            physical=False,
        )
        with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name:
            folder = Path(name)
            on_step(f"tasks of the {writer} writer")
            summary = build_dataset(
                folder, settings, jobs=jobs, making=DAYS if writer is WriterKind.SOCIAL else None
            )
            refused += summary.rejected.get("shortcut", 0) + summary.rejected.get("unfaithful", 0)
            records = Dataset.load(folder).records
            scenes = Counter(base_scene_of(record.task.scene_id) for record in records)
            each = math.ceil(sizes.plans / min(scenes.values()))
            on_step(f"{each * len(records):,} plans against the {writer} writer's instructions")
            found = audit_dataset(folder, records, plans=each, answers=PolicyAnswers(), jobs=jobs)
            for record, audit in zip(records, found, strict=True):
                executed[base_scene_of(record.task.scene_id)] += audit.tried
            audits += found
    return (
        *evaluation_of(audits, {}).figures,
        Figure("plans_tried_in_a_scene", min(executed.values()), "count", Better.HIGHER, len(executed)),
        Figure("drafts_refused_by_audit", refused, "count", Better.LOWER, len(audits)),
    )
