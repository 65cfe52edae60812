"""Metrics and samples of a run as JSON lines, written at once so that a crash loses nothing."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from embomatrix.trainer.grpo.records import GroupLog, StepRecord
from embomatrix.trainer.logging.evaluations import DURING, EVALUATIONS, lines_of
from embomatrix.trainer.logging.trackers import GRPO_PHASE, IMITATION_PHASE, Tracker
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from embomatrix.trainer.cluster.gateway import PlanOutcome
    from embomatrix.trainer.evaluation.held_out import HeldOutEvaluation
    from embomatrix.trainer.imitation.teacher_forcing import ImitationProgress

METRICS = "metrics.jsonl"
SAMPLES = "samples.jsonl"
IMITATION = "imitation.jsonl"


class Recorder:
    """Appends to the files in a run's folder and forwards the numbers to ``trackers``. Raises OSError if a write fails."""

    def __init__(self, folder: Path, trackers: Sequence[Tracker] = ()) -> None:
        self._folder = folder
        self._trackers = tuple(trackers)
        folder.mkdir(parents=True, exist_ok=True)

    def step(self, record: StepRecord, seconds: float, spent_s: Mapping[str, float]) -> None:
        """Record a GRPO step. ``seconds`` is its wall-clock time, ``spent_s`` the run's time so far by activity."""
        spent = {activity: round(value, 4) for activity, value in spent_s.items()}
        row = {**asdict(record), "seconds": round(seconds, 4), "spent_s": spent}
        self._append(METRICS, row)
        self._track(GRPO_PHASE, row)

    def samples(self, step: int, log: GroupLog) -> None:
        """Record one task's plans: text, reward by tier, and the result of each step."""
        for outcome, advantage in zip(log.outcomes, log.advantages, strict=True):
            task = {
                "step": step,
                "task": log.task.task.task_id,
                "instruction": log.task.task.instruction,
            }
            self._append(SAMPLES, {**task, "advantage": round(advantage, 4), **_plan_to_json(outcome)})

    def imitation(self, progress: ImitationProgress) -> None:
        """Record an imitation step."""
        row = asdict(progress)
        self._append(IMITATION, row)
        self._track(IMITATION_PHASE, row)

    def evaluation(self, step: int, label: str, result: HeldOutEvaluation) -> None:
        """Record an evaluation after a step of GRPO, and forward its success to the trackers."""
        with (self._folder / EVALUATIONS).open("a", encoding="utf-8") as file:
            file.write(lines_of(step, label, result.answers))
        rates = {category: result.success(category).value for category in result.categories}
        at = step if label == DURING else 0
        self._track(f"success {label}", {"step": at, "all": result.success().value, **rates})

    def forget_after(self, step: int, *names: str) -> None:
        """Drop later steps from the files: a resumed run takes them again."""
        for name in names:
            path = self._folder / name
            if path.exists():
                kept = [line for line in path.read_bytes().splitlines() if _step_of(line) <= step]
                write_whole(path, b"".join(line + b"\n" for line in kept))

    def _track(self, phase: str, row: Mapping[str, Any]) -> None:
        values = dict(numbers_of(row))
        step = int(values.pop("step"))
        for tracker in self._trackers:
            tracker.log(phase, step, values)

    def _append(self, name: str, value: Mapping[str, Any]) -> None:
        with (self._folder / name).open("a", encoding="utf-8") as file:
            file.write(json.dumps(value) + "\n")


def numbers_of(row: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a row by name. Nested numbers get the name ``table/name``."""
    for name, value in row.items():
        if isinstance(value, Mapping):
            yield from ((f"{name}/{inner}", number) for inner, number in numbers_of(value))
        elif value is not None:
            yield name, float(value)


def _step_of(line: bytes) -> float:
    """Step of a line; infinity for a line that a crash truncated, so it is dropped."""
    try:
        return int(parse_json(line)["step"])
    except (ValueError, LookupError, TypeError, OverflowError):
        return math.inf


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Read the record of every step, oldest first. Empty before the first step."""
    path = folder / METRICS
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _plan_to_json(outcome: PlanOutcome) -> dict[str, Any]:
    row: dict[str, Any] = {"text": outcome.text}
    if outcome.reward is not None:
        reward = outcome.reward
        row |= {
            "reward": reward.total,
            **reward.tiers,
            "success": reward.success,
            "atoms": [[atom.text, atom.holds] for atom in reward.atoms],
        }
    if outcome.problem:
        row["unparsable"] = outcome.problem
    elif outcome.lost:
        row["lost"] = outcome.lost
    else:
        row["steps"] = [[step.call.skill.value, step.ok, step.message] for step in outcome.steps]
    return row
