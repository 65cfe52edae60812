"""Measured difficulty: records with the success of scripts and of a small policy, and selections by level."""

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from embomatrix.factory.evaluate.scripts import ScriptName, ScriptResults
from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.world.dataset import SPLITS, TaskRecord
from embomatrix.world.difficulty import Difficulty, DifficultyLevel, shuffle_key
from embomatrix.world.json_text import parse_json

Shares = Mapping[DifficultyLevel, float]
"""Wanted share of each level. They add up to 1."""
_TOLERANCE: Final = 1e-6


def with_scripts(records: Sequence[TaskRecord], results: ScriptResults) -> list[TaskRecord]:
    """Return records with the measured success of the scripts. Records without a result stay as they are."""
    return [
        replace(record, difficulty=_difficulty(record, results[record.task.task_id]))
        if record.task.task_id in results
        else record
        for record in records
    ]


def _difficulty(record: TaskRecord, result: Mapping[ScriptName, bool]) -> Difficulty:
    before = record.difficulty
    return Difficulty(
        template=result[ScriptName.TEMPLATE],
        nearest=result[ScriptName.NEAREST],
        greedy=result[ScriptName.GREEDY],
        steps=len(record.oracle),
        small_policy=None if before is None else before.small_policy,
    )


def with_policy(records: Sequence[TaskRecord], shares: Mapping[str, float]) -> list[TaskRecord]:
    """Return records with the success share of a small policy, by task id. Other tasks stay as they are."""
    return [
        replace(record, difficulty=replace(record.difficulty, small_policy=shares[record.task.task_id]))
        if record.difficulty is not None and record.task.task_id in shares
        else record
        for record in records
    ]


def read_policy_shares(path: Path) -> dict[str, float]:
    """Read the success share of each task from the report.json of an evaluation. Lost plans don't count.

    Raises EvaluationError for another file.
    """
    try:
        tasks = parse_json(path.read_bytes())["verdicts"]
        known = {
            str(task["task"]): [
                bool(sample["success"]) for sample in task["samples"] if not sample.get("lost")
            ]
            for task in tasks
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise EvaluationError(
            f"{path} contains no verdicts of an evaluation ({error!r}): expected the report.json that `embomatrix eval` wrote"
        ) from error
    return {task_id: sum(held) / len(held) for task_id, held in known.items() if held}


def shares_of(easy: float | None, hard: float | None) -> Shares:
    """Return the shares of all levels from those of easy and hard tasks. Raises EvaluationError if they exceed 1."""
    easy_share, hard_share = easy or 0.0, hard or 0.0
    if easy_share + hard_share > 1 + _TOLERANCE:
        raise EvaluationError(
            f"the shares of easy and hard tasks add up to {easy_share + hard_share:g}: expected at most 1, the rest is medium"
        )
    return {
        DifficultyLevel.EASY: easy_share,
        DifficultyLevel.MEDIUM: max(0.0, 1 - easy_share - hard_share),
        DifficultyLevel.HARD: hard_share,
    }


def selected(
    records: Sequence[TaskRecord], shares: Shares, splits: Collection[str] = SPLITS
) -> list[TaskRecord]:
    """Return the largest set of records whose levels have these shares, up to rounding, in each split by itself.

    Which tasks of a level are taken depends only on their ids. The order of the records is kept, and so are all records of
    other splits than ``splits``. Raises EvaluationError if a split has no task of a wanted level.
    """
    chosen = {
        record.task.task_id
        for split in splits
        for record in _of_split(split, [record for record in records if record.split == split], shares)
    }
    return [record for record in records if record.split not in splits or record.task.task_id in chosen]


def _of_split(split: str, records: Sequence[TaskRecord], shares: Shares) -> list[TaskRecord]:
    levels: dict[DifficultyLevel, list[TaskRecord]] = {level: [] for level in DifficultyLevel}
    for record in sorted(records, key=lambda record: shuffle_key(record.task.task_id)):
        if record.difficulty is not None:
            levels[record.difficulty.level].append(record)
    wanted = {level: share for level, share in shares.items() if share > _TOLERANCE}
    missing = next((level for level in wanted if not levels[level]), None)
    if records and missing is not None:
        raise EvaluationError(
            f"the split {split} has no {missing} task, and {wanted[missing]:.0%} of the selection should be {missing}: select "
            "from the other split only (--split), or change the shares"
        )
    total = min(len(levels[level]) / share for level, share in wanted.items())
    return [
        record
        for level, share in wanted.items()
        for record in levels[level][: math.floor(total * share + _TOLERANCE)]
    ]


def level_counts(records: Sequence[TaskRecord]) -> dict[str, Counter[DifficultyLevel]]:
    """Count the tasks of each level by split. Tasks without a difficulty are left out."""
    return {
        split: Counter(
            record.difficulty.level
            for record in records
            if record.split == split and record.difficulty is not None
        )
        for split in SPLITS
    }
