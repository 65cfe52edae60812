"""Which plans are worth a picture: of each category one that succeeds, and one for what fails most often."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.skills.describe import call_in_words
from embomatrix.trainer.evaluation.page import Picture

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from embomatrix.skills.syntax import Plan
    from embomatrix.trainer.evaluation.benchmark import Benchmark
    from embomatrix.trainer.evaluation.scoreboard import Scoreboard
    from embomatrix.trainer.evaluation.verdicts import AnswerVerdict

MOST: Final = 8


def chosen_pictures(
    bench: Benchmark, board: Scoreboard, plans: Mapping[tuple[str, int], Plan]
) -> tuple[Picture, ...]:
    """At most ``MOST``, the same for the same verdicts. ``plans`` by task and sample: texts that are no plan have none."""
    records = {record.task.task_id: record for record in bench.records}
    return tuple(
        Picture(
            bench.scene(records[verdict.task_id]),
            records[verdict.task_id].task,
            plans[verdict.task_id, verdict.sample],
            tuple(
                call_in_words(call, records[verdict.task_id].task.table)
                for call in plans[verdict.task_id, verdict.sample]
            ),
            verdict,
        )
        for verdict in list(_chosen(board, plans))[:MOST]
    )


def _chosen(board: Scoreboard, plans: Mapping[tuple[str, int], Plan]) -> Iterator[AnswerVerdict]:
    """The first of each kind, in the order of the benchmark."""
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
