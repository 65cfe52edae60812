"""Held-out evaluations of a run as JSON lines: each sampled plan with its verdict."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from embomatrix.skills.parse import plan_from_json, plan_to_json
from embomatrix.trainer.evaluation.held_out import HeldOutAnswer
from embomatrix.trainer.evaluation.scoreboard import Scoreboard
from embomatrix.trainer.evaluation.taxonomy import Cause
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict
from embomatrix.world.json_text import parse_json
from embomatrix.world.task import Profile, TaskCategory

EVALUATIONS: Final = "evaluations.jsonl"
BEFORE: Final = "before GRPO"
DURING: Final = "during GRPO"
AFTER: Final = "after GRPO"


@dataclass(frozen=True, slots=True)
class RecordedEvaluation:
    """Evaluation after ``step`` steps of GRPO. ``label`` is one of ``BEFORE``, ``DURING``, ``AFTER``."""

    step: int
    label: str
    answers: tuple[HeldOutAnswer, ...]

    def board(self, categories: Mapping[str, TaskCategory]) -> Scoreboard:
        """Figures of the evaluation. ``categories`` maps the ids of the held-out tasks to their categories."""
        known = [answer.verdict for answer in self.answers if answer.verdict.task_id in categories]
        asked = {verdict.task_id for verdict in known}
        return Scoreboard.of({name: kind for name, kind in categories.items() if name in asked}, known)


def lines_of(step: int, label: str, answers: Iterable[HeldOutAnswer]) -> str:
    """Return the lines of an evaluation, one for each answer."""
    rows = (
        {
            "step": step,
            "label": label,
            "verdict": asdict(each.verdict),
            "text": each.text,
            "plan": plan_to_json(each.plan),
        }
        for each in answers
    )
    return "".join(f"{json.dumps(row)}\n" for row in rows)


def read_evaluations(folder: Path) -> tuple[RecordedEvaluation, ...]:
    """Read the evaluations of a run, in their order. Of one that was written twice, the later answers count.

    Lines that a crash cut off are left out; their evaluation is repeated by a resumed run.
    """
    path = folder / EVALUATIONS
    found: dict[tuple[int, str], dict[tuple[str, int], HeldOutAnswer]] = {}
    for row in _rows(path.read_bytes().splitlines() if path.exists() else ()):
        given: dict[str, Any] = row["verdict"]
        verdict = AnswerVerdict(**{**given, "cause": given["cause"] and Cause(given["cause"])})
        answers = found.setdefault((row["step"], row["label"]), {})
        plan = plan_from_json(row["plan"], Profile.HOUSEHOLD) if row["plan"] else ()
        answers[verdict.task_id, verdict.sample] = HeldOutAnswer(row["text"], verdict, plan)
    return tuple(
        RecordedEvaluation(step, label, tuple(answers.values())) for (step, label), answers in found.items()
    )


def _rows(lines: Sequence[bytes]) -> Iterator[dict[str, Any]]:
    for line in lines:
        with contextlib.suppress(ValueError):
            yield parse_json(line)
