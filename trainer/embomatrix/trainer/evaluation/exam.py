"""Exams: benchmarks with their questions and their judge."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from embomatrix.skills.prompt import Codec, Prompt, limited, prompt_for
from embomatrix.trainer.cluster.executor import Executor
from embomatrix.trainer.evaluation.benchmark import Benchmark
from embomatrix.trainer.evaluation.intervals import Estimate, mean_over_tasks
from embomatrix.trainer.evaluation.judging import judge_answers
from embomatrix.trainer.evaluation.pictures import Picture, chosen_pictures
from embomatrix.trainer.evaluation.scoreboard import Scoreboard
from embomatrix.world.dataset import TaskRecord
from embomatrix.world.difficulty import DifficultyLevel

if TYPE_CHECKING:
    from embomatrix.trainer.evaluation.answers import Answer, EvaluationSetup


@dataclass(frozen=True, slots=True)
class Question:
    """Prompt of one task."""

    task_id: str
    prompt: Prompt


@dataclass(frozen=True)
class ExamResult:
    """Figures of an exam, plans to draw, and additional figures by name."""

    board: Scoreboard
    pictures: Sequence[Picture]
    others: Mapping[str, Estimate] = field(default_factory=dict)


class WorldExam:
    """Benchmark of our own tasks, executed in our simulator.

    ``digest`` identifies the tasks. ``by_rule`` counts those that can't be expressed and count as failed.
    """

    def __init__(self, bench: Benchmark, executor: Executor) -> None:
        self.bench = bench
        self._executor = executor
        self.name, self.digest, self.split = bench.name, bench.digest, bench.split
        self.task_ids = tuple(record.task.task_id for record in bench.records)
        self.by_rule = len(bench.failed_by_rule)

    def questions(self, codec: Codec, rows: int) -> tuple[Question, ...]:
        """Return one question per task, with at most ``rows`` rows of its object table. Raises TrainerError."""
        return tuple(
            Question(task_id, prompt_for(limited(task.situation, rows), codec))
            for task_id, task in self.bench.tasks.items()
        )

    def judge(
        self, setup: EvaluationSetup, answers: Sequence[Answer], report: Callable[[int, int], None]
    ) -> ExamResult:
        """Judge answers. ``report`` gets the number of judged plans and the total. Raises TrainerError and ClusterError."""
        judged = judge_answers(self.bench, setup, self._executor, answers, report)
        categories = {record.task.task_id: record.task.category for record in self.bench.records}
        board = Scoreboard.of(categories, judged.verdicts, self.by_rule)
        by_level = success_by_level(self.bench.records, board)
        return ExamResult(board, chosen_pictures(self.bench, board, judged.plans), by_level)


def success_by_level(records: Sequence[TaskRecord], board: Scoreboard) -> dict[str, Estimate]:
    """Return the success on tasks of each difficulty level, by the name of the figure. Tasks without a level are left out."""
    levels = {
        record.task.task_id: record.difficulty.level for record in records if record.difficulty is not None
    }
    rates = {
        level: [task.rate for task in board.tasks if levels.get(task.task_id) is level]
        for level in DifficultyLevel
    }
    return {
        f"success on {level} tasks ({len(found)})": mean_over_tasks(found)
        for level, found in rates.items()
        if found
    }
