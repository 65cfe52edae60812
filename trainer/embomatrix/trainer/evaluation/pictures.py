"""Selection of the plans to draw: per category, one success and one failure of the most frequent cause."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.skills.describe import call_in_words
from embomatrix.skills.syntax import Plan
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.trainer.evaluation.benchmark import Benchmark
    from embomatrix.trainer.evaluation.scoreboard import Scoreboard
    from embomatrix.world.scene import Scene

MAX_PICTURES: Final = 8


@dataclass(frozen=True, slots=True)
class Picture:
    """Plan to draw, with its verdict. ``lines`` are its calls in words."""

    scene: Scene
    task: Task
    plan: Plan
    lines: tuple[str, ...]
    verdict: AnswerVerdict


def chosen_pictures(
    bench: Benchmark, board: Scoreboard, plans: Mapping[tuple[str, int], Plan]
) -> tuple[Picture, ...]:
    """Return at most ``MAX_PICTURES`` pictures, equal for equal verdicts.

    ``plans`` holds the parsable plans by (task, sample).
    """
    records = {record.task.task_id: record for record in bench.records}
    pictures = []
    for verdict in list(_chosen(board, plans))[:MAX_PICTURES]:
        record, plan = records[verdict.task_id], plans[verdict.task_id, verdict.sample]
        calls = tuple(call_in_words(call, record.task.table) for call in plan)
        pictures.append(Picture(bench.scene(record), record.task, plan, calls, verdict))
    return tuple(pictures)


def _chosen(board: Scoreboard, plans: Mapping[tuple[str, int], Plan]) -> Iterator[AnswerVerdict]:
    """First verdict of each kind, in benchmark order."""
    for category in board.categories:
        verdicts = [
            verdict
            for task in board.of_category(category)
            for verdict in task.known
            if (verdict.task_id, verdict.sample) in plans
        ]
        yield from [verdict for verdict in verdicts if verdict.success][:1]
        for cause, _ in board.causes(category).most_common():
            failed = [verdict for verdict in verdicts if verdict.cause is cause]
            if failed:
                yield failed[0]
                break
