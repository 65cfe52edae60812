"""The table of an evaluation in the form of the paper's: a row for each model, a column for all tasks and for each category."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.evaluation.scoreboard import estimate_to_json
from embomatrix.trainer.evaluation.taxonomy import MEANINGS, Cause
from embomatrix.world.task import TaskCategory

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from embomatrix.trainer.evaluation.answers import EvaluationSetup
    from embomatrix.trainer.evaluation.exam import Marked

VERSION: Final = 1
NONE: Final = "–"
COLUMNS: Final[Mapping[TaskCategory, str]] = {
    TaskCategory.PICK_AND_PLACE: "pick and place",
    TaskCategory.APPLIANCE_USE: "appliance using",
    TaskCategory.KITCHEN_OPERATION: "kitchen operation",
    TaskCategory.COMPOUND: "compound",
}
"""The categories by the paper's names, in its order."""
INTERVALS: Final = (
    "Brackets: 95 % intervals over tasks (percentile bootstrap of tasks with all their samples; Wilson's, with the tasks as "
    "trials, where all tasks are alike)."
)


@dataclass(frozen=True, slots=True)
class ScoreRow:
    """One line of the table: a model's name and its figures as a report holds them."""

    label: str
    figures: Mapping[str, Any]


def report_of(setup: EvaluationSetup, marked: Marked) -> dict[str, Any]:
    """The evaluation as JSON. Equal answers give equal bytes, wherever their plans are executed."""
    others = {name: estimate_to_json(found) for name, found in marked.others.items()}
    return {"report": VERSION, "setup": asdict(setup), **marked.board.as_json(), "others": others}


def read_row(path: Path, bench_digest: str) -> ScoreRow:
    """The row of another evaluation's report on the same tasks. Raises TrainerError."""
    try:
        value = json.loads(path.read_bytes())
        version, setup = value["report"], value["setup"]
        if version != VERSION:
            raise TrainerError(
                f"the report {path} is of another version (found {version!r}, expected {VERSION}): evaluate its answers again"
            )
        label, digest = str(setup["model"]), setup["bench_digest"]
        row = ScoreRow(label, {"overall": value["overall"], "categories": value["categories"]})
        table([row], "success")
    except OSError as error:
        raise TrainerError(
            f"the report {path} can't be read ({error.strerror}): expected the report.json of an evaluation"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise TrainerError(f"{path} is no report of an evaluation: expected its report.json") from error
    if digest != bench_digest:
        raise TrainerError(
            f"{path} reports on other tasks: only rows on the same benchmark stand in one table"
        )
    return row


def head(figures: Mapping[str, Any]) -> tuple[str, ...]:
    """Titles of the columns, each with its number of tasks."""
    counts = [f"{title} ({_tasks(figures, category)})" for category, title in COLUMNS.items()]
    return ("model", f"all ({figures['overall']['tasks']})", *counts)


def table(rows: Iterable[ScoreRow], figure: str) -> list[tuple[str, ...]]:
    """A line for each row with "success" or "partial" of all tasks and of each category, in percent."""
    return [
        (
            row.label,
            percent(row.figures["overall"][figure]),
            *(
                percent(row.figures["categories"][category.value][figure])
                if category.value in row.figures["categories"]
                else NONE
                for category in COLUMNS
            ),
        )
        for row in rows
    ]


def percent(estimate: Mapping[str, Any]) -> str:
    """An estimate of a report: ``48.7 [40.1, 57.3]``."""
    if estimate["value"] is None:
        return NONE
    value, low, high = (100 * estimate[name] for name in ("value", "low", "high"))
    return f"{value:.1f} [{low:.1f}, {high:.1f}]"


def pass_rows(figures: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """A line for each k: pass@k of all tasks and of each category."""
    groups = [figures["overall"], *(figures["categories"].get(category.value) for category in COLUMNS)]
    return [
        (
            f"pass@{k}",
            *(percent(group["pass_at"][k]) if group and k in group["pass_at"] else NONE for group in groups),
        )
        for k in figures["overall"]["pass_at"]
    ]


def cause_rows(report: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Cause, plans, share of all plans that have a result, and what the cause means, with the reasons counted."""
    known = max(1, report["samples"] - report["lost"])
    rows = []
    for name, count in report["overall"]["causes"].items():
        reasons = report["reasons"][name]
        told = ", ".join(f"{reason} {times}" for reason, times in reasons.items() if reason != name)
        meaning = MEANINGS[Cause(name)]
        rows.append((name, str(count), f"{count / known:.1%}", f"{meaning} ({told})" if told else meaning))
    return rows


def text_report(report: Mapping[str, Any], beside: Sequence[ScoreRow] = ()) -> str:
    """The whole evaluation as plain text, for a terminal, a log or an e-mail."""
    setup = report["setup"]
    rows = [ScoreRow(setup["model"], report), *beside]
    parts = [
        f"{setup['bench']} ({setup['split']}): {report['tasks']} tasks, {setup['samples']} samples each, temperature "
        f"{setup['temperature']:g}, {report['lost']} of {report['samples']} plans lost by the infrastructure",
        _grid("success, %", [head(report), *table(rows, "success")]),
        _grid(
            "partial credit (share of sub-goals that hold at the end), %",
            [head(report), *table(rows, "partial")],
        ),
        _grid("chance that one of k samples succeeds, %", [("", *head(report)[1:]), *pass_rows(report)]),
    ]
    if report["tasks_failed_by_rule"]:
        parts.append(
            f"{report['tasks_failed_by_rule']} more tasks can't be expressed with these skills, or were refused; where they "
            f"count as failed: {percent(report['success_over_all'])} %"
        )
    if report["others"]:
        parts.append("\n".join(f"{name}, %: {percent(found)}" for name, found in report["others"].items()))
    if report["overall"]["causes"]:
        parts.append(_grid("why plans failed", [("cause", "plans", "share", "meaning"), *cause_rows(report)]))
    return "\n\n".join([*parts, INTERVALS]) + "\n"


def _tasks(figures: Mapping[str, Any], category: TaskCategory) -> int:
    found = figures["categories"].get(category.value)
    return int(found["tasks"]) if found else 0


def _grid(title: str, rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[at]) for row in rows) for at in range(len(rows[0]))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
    return "\n".join([title, *(f"  {line}" for line in lines)])
