"""Tasks of which a training report shows a plan before and one after GRPO."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.skills.describe import call_in_words
from embomatrix.trainer.data.tasks import TaskSet, TrainingTask
from embomatrix.trainer.evaluation.held_out import HeldOutAnswer
from embomatrix.trainer.evaluation.pictures import Picture
from embomatrix.trainer.logging.evaluations import RecordedEvaluation
from embomatrix.world.bundle import decode_bundle
from embomatrix.world.dataset import DatasetError
from embomatrix.world.inflation import BundleError
from embomatrix.world.scene import Scene

LEARNED: Final = "learned"
LOST: Final = "lost"
KEPT: Final = "succeeds before and after"
FAILS: Final = "fails before and after"

Answers = Mapping[str, Sequence[HeldOutAnswer]]


@dataclass(frozen=True, slots=True)
class Example:
    """Plans of one task. ``change`` says how its success changed."""

    change: str
    before: Picture
    after: Picture


def examples_of(before: RecordedEvaluation, after: RecordedEvaluation, tasks: TaskSet) -> tuple[Example, ...]:
    """Return up to three tasks: the one that gained most, the one that lost most or succeeds anyway, one that fails anyway."""
    by_id = {task.task.task_id: task for task in tasks.heldout}
    earlier, later = _by_task(before), _by_task(after)
    found: dict[str, Example] = {}
    for change, task_id, first, second in _candidates(earlier, later):
        kind = LOST if change == KEPT else change
        if kind in found or task_id not in by_id:
            continue
        task = by_id[task_id]
        # A damaged bundle costs a picture, not the report of a long run.
        with contextlib.suppress(BundleError, DatasetError):
            scene = decode_bundle(tasks.bundle_bytes(task.bundle_digest)).scene
            found[kind] = Example(change, _picture(scene, task, first), _picture(scene, task, second))
    return tuple(found.values())


def _candidates(earlier: Answers, later: Answers) -> Iterator[tuple[str, str, HeldOutAnswer, HeldOutAnswer]]:
    """Yield change, task and both answers: first what was learned and lost, by the change of the success rate."""
    both = [task_id for task_id in earlier if task_id in later]
    rates = {task_id: (_rate(earlier[task_id]), _rate(later[task_id])) for task_id in both}
    for change, wanted, ordered in (
        (LEARNED, (False, True), sorted(both, key=lambda name: rates[name][0] - rates[name][1])),
        (LOST, (True, False), sorted(both, key=lambda name: rates[name][1] - rates[name][0])),
        (KEPT, (True, True), both),
        (FAILS, (False, False), [name for name in both if rates[name] == (0.0, 0.0)]),
    ):
        for task_id in ordered:
            was, now = rates[task_id]
            if (change == LEARNED and now <= was) or (change == LOST and now >= was):
                continue
            first, second = _with(earlier[task_id], wanted[0]), _with(later[task_id], wanted[1])
            if first is not None and second is not None:
                yield change, task_id, first, second


def _with(answers: Sequence[HeldOutAnswer], success: bool) -> HeldOutAnswer | None:
    """Return the first executed plan that succeeded or failed."""
    return next((each for each in answers if each.plan and each.verdict.success is success), None)


def _by_task(evaluation: RecordedEvaluation) -> dict[str, list[HeldOutAnswer]]:
    found: dict[str, list[HeldOutAnswer]] = {}
    for answer in evaluation.answers:
        if answer.verdict.lost:
            continue
        found.setdefault(answer.verdict.task_id, []).append(answer)
    return found


def _rate(answers: Sequence[HeldOutAnswer]) -> float:
    return sum(answer.verdict.success for answer in answers) / len(answers)


def _picture(scene: Scene, task: TrainingTask, answer: HeldOutAnswer) -> Picture:
    lines = tuple(call_in_words(call, task.task.table) for call in answer.plan)
    return Picture(scene, task.task, answer.plan, lines, answer.verdict)
