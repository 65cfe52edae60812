"""Tables of an evaluation in the form of the paper's: a row per model, a column per category."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.evaluation.intervals import paired_difference
from embomatrix.trainer.evaluation.scoreboard import estimate_to_json
from embomatrix.trainer.evaluation.taxonomy import MEANINGS, Cause
from embomatrix.world.json_text import parse_json
from embomatrix.world.task import TaskCategory

if TYPE_CHECKING:
    from embomatrix.trainer.evaluation.answers import EvaluationSetup
    from embomatrix.trainer.evaluation.exam import ExamResult

VERSION: Final = 1
NONE: Final = "–"
COLUMNS: Final[Mapping[TaskCategory, str]] = {
    category: category.words
    for category in (
        TaskCategory.PICK_AND_PLACE,
        TaskCategory.APPLIANCE_USE,
        TaskCategory.KITCHEN_OPERATION,
        TaskCategory.COMPOUND,
    )
}
"""Names of the categories, in the order of the paper's table."""
INTERVALS: Final = (
    "Brackets: 95 % intervals over tasks (percentile bootstrap over tasks; Wilson intervals with tasks as trials if all tasks "
    "have the same rate)."
)


@dataclass(frozen=True, slots=True)
class ReportTable:
    """Table of a report, for text and HTML. The first row holds the column titles."""

    title: str
    rows: Sequence[tuple[str, ...]]


@dataclass(frozen=True, slots=True)
class ScoreRow:
    """Table row: a model's name, and its figures as in a report."""

    label: str
    figures: Mapping[str, Any]


def report_of(setup: EvaluationSetup, result: ExamResult) -> dict[str, Any]:
    """JSON report of an evaluation. Equal answers give equal bytes, wherever the plans are executed."""
    others = {name: estimate_to_json(found) for name, found in result.others.items()}
    return {"report": VERSION, "setup": asdict(setup), **result.board.as_json(), "others": others}


def read_row(path: Path, bench_digest: str) -> ScoreRow:
    """Read the row of another report on the same tasks. Raises TrainerError."""
    try:
        value = parse_json(path.read_bytes())
        version, setup = value["report"], value["setup"]
        if version != VERSION:
            raise TrainerError(
                f"the report {path} has another version (found {version!r}, expected {VERSION}): evaluate its answers again"
            )
        label, digest = str(setup["model"]), setup["bench_digest"]
        shown = {name: value[name] for name in ("overall", "categories", "verdicts")}
        row = ScoreRow(label, shown)
        table([row], "success")
        rates_of(shown)
    except OSError as error:
        raise TrainerError(
            f"the report {path} can't be read ({error.strerror}): expected the report.json of an evaluation"
        ) from error
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise TrainerError(
            f"{path} is not an evaluation report: expected the report.json of an evaluation"
        ) from error
    if digest != bench_digest:
        raise TrainerError(f"{path} reports on other tasks: pass a report on the same benchmark")
    return row


def head(figures: Mapping[str, Any]) -> tuple[str, ...]:
    """Titles of the columns, each with its number of tasks."""
    counts = [f"{title} ({_tasks(figures, category)})" for category, title in COLUMNS.items()]
    return ("model", f"all ({figures['overall']['tasks']})", *counts)


def table(rows: Iterable[ScoreRow], figure: str) -> list[tuple[str, ...]]:
    """Rows with "success" or "partial" of all tasks and of each category, in percent."""
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


def rates_of(figures: Mapping[str, Any], category: TaskCategory | None = None) -> dict[str, float]:
    """Share of successful samples of each task of a category; NaN if all were lost. None: of all tasks."""
    found = {}
    for task in figures["verdicts"]:
        known = [bool(sample["success"]) for sample in task["samples"] if not sample.get("lost")]
        if category in (None, task["category"]):
            found[str(task["task"])] = sum(known) / len(known) if known else math.nan
    return found


def difference_row(report: Mapping[str, Any], other: ScoreRow) -> tuple[str, ...]:
    """Row of the differences in success between a report and another one, paired by task, with their intervals."""
    cells = []
    for category in (None, *COLUMNS):
        change = paired_difference(rates_of(other.figures, category), rates_of(report, category))
        value, low, high = (100 * each for each in (change.value, change.low, change.high))
        cells.append(NONE if math.isnan(value) else f"{value:+.1f} [{low:.1f}, {high:.1f}]")
    return (other.label, *cells)


def percent(estimate: Mapping[str, Any]) -> str:
    """Format an estimate of a report: ``48.7 [40.1, 57.3]``."""
    if estimate["value"] is None:
        return NONE
    value, low, high = (100 * estimate[name] for name in ("value", "low", "high"))
    return f"{value:.1f} [{low:.1f}, {high:.1f}]"


def pass_rows(figures: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Rows of pass@k for all tasks and each category."""
    groups = [figures["overall"], *(figures["categories"].get(category.value) for category in COLUMNS)]
    return [
        (
            f"pass@{k}",
            *(percent(group["pass_at"][k]) if group and k in group["pass_at"] else NONE for group in groups),
        )
        for k in figures["overall"]["pass_at"]
    ]


def cause_rows(report: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Rows of cause, number of plans, share of all known plans, and meaning with the counted reasons."""
    known = max(1, report["samples"] - report["lost"])
    rows = []
    for name, count in report["overall"]["causes"].items():
        reasons = report["reasons"][name]
        counts = ", ".join(f"{reason} {times}" for reason, times in reasons.items() if reason != name)
        meaning = MEANINGS[Cause(name)]
        rows.append(
            (
                name.replace("_", " "),
                str(count),
                f"{count / known:.1%}",
                f"{meaning} ({counts})" if counts else meaning,
            )
        )
    return rows


def score_tables(report: Mapping[str, Any], beside: Sequence[ScoreRow] = ()) -> tuple[ReportTable, ...]:
    """Tables of success, partial credit and pass@k. ``beside`` are the rows of other reports on the same tasks."""
    rows, titles = [ScoreRow(report["setup"]["model"], report), *beside], head(report)
    differences = [difference_row(report, other) for other in beside]
    paired = "success minus that of others on the same tasks, points"
    partial = "partial credit (share of subgoals that hold at the end), %"
    passes = [("", *titles[1:]), *pass_rows(report)]
    return (
        ReportTable("success, %", [titles, *table(rows, "success")]),
        *([ReportTable(paired, [("minus", *titles[1:]), *differences])] if differences else []),
        ReportTable(partial, [titles, *table(rows, "partial")]),
        ReportTable("probability that at least one of k samples succeeds, %", passes),
    )


def cause_tables(report: Mapping[str, Any]) -> tuple[ReportTable, ...]:
    """Table of the causes of failure, none if no plan failed."""
    rows = cause_rows(report)
    return (ReportTable("why plans failed", [("cause", "plans", "share", "meaning"), *rows]),) if rows else ()


def about(report: Mapping[str, Any]) -> str:
    """Benchmark and sampling of an evaluation in one line."""
    setup = report["setup"]
    episodes = (
        f", in episodes of at most {setup['calls_factor']:g} times the oracle's calls and {setup['calls_more']} "
        f"(visibility {setup['visibility']})"
        if setup.get("visibility")
        else ""
    )
    return (
        f"{setup['bench']} ({setup['split']}): {report['tasks']} tasks, {setup['samples']} samples each{episodes}, temperature "
        f"{setup['temperature']:g}, {report['lost']} of {report['samples']} plans lost to the infrastructure"
    )


def notes(report: Mapping[str, Any]) -> list[str]:
    """Additional figures: success over all tasks, and the exam's own figures."""
    found = []
    if report["tasks_failed_by_rule"]:
        found.append(
            f"{report['tasks_failed_by_rule']} more tasks can't be expressed with these skills, or were rejected; if they "
            f"count as failed: {percent(report['success_over_all'])} %"
        )
    if report["others"]:
        found.append("\n".join(f"{name}, %: {percent(value)}" for name, value in report["others"].items()))
    return found


def text_report(report: Mapping[str, Any], beside: Sequence[ScoreRow] = ()) -> str:
    """Whole evaluation as plain text."""
    scores, causes = map(_grid, score_tables(report, beside)), map(_grid, cause_tables(report))
    return "\n\n".join([about(report), *scores, *notes(report), *causes, INTERVALS]) + "\n"


def _tasks(figures: Mapping[str, Any], category: TaskCategory) -> int:
    found = figures["categories"].get(category.value)
    return int(found["tasks"]) if found else 0


def _grid(table: ReportTable) -> str:
    widths = [max(map(len, column)) for column in zip(*table.rows, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table.rows
    ]
    return "\n".join([table.title, *(f"  {line}" for line in lines)])
