"""HTML page of an evaluation: one file without scripts or external resources."""

import html
import string
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import PurePath
from typing import Any

from embomatrix.pages.head import html_table, page_head
from embomatrix.trainer.evaluation.pictures import Picture
from embomatrix.trainer.evaluation.plan_view import css_class, plan_view
from embomatrix.trainer.evaluation.table import (
    INTERVALS,
    NONE,
    ReportTable,
    ScoreRow,
    about,
    cause_tables,
    notes,
    score_tables,
)


def evaluation_page(
    report: Mapping[str, Any], pictures: Sequence[Picture], beside: Sequence[ScoreRow] = ()
) -> str:
    """Return the page of a report, with the rows of other reports on the same tasks below its own."""
    template = files("embomatrix.trainer.evaluation").joinpath("page.html").read_text(encoding="utf-8")
    setup = report["setup"]
    title = f"{setup['model']} on {PurePath(setup['bench']).name}"
    tasks = [_task_row(task) for task in report["verdicts"]]
    return string.Template(template).substitute(
        head=page_head(f"{title} · EmboMatrix evaluation"),
        page_style=page_style(),
        title=html.escape(title),
        about=html.escape(about(report)),
        scores="".join(map(_section, score_tables(report, beside))),
        notes="".join(f"<section class='lines'>{html.escape(note)}</section>" for note in notes(report)),
        causes="".join(map(_section, cause_tables(report))),
        pictures="".join(picture_section(picture, picture.task.task_id) for picture in pictures),
        count=report["tasks"],
        tasks=html_table([("task", "category", "succeeded", "partial", "causes"), *tasks]),
        intervals=html.escape(INTERVALS),
        digest=html.escape(setup["bench_digest"].removeprefix("sha256:")[:16]),
    )


def _section(table: ReportTable) -> str:
    return f"<section><h2>{html.escape(table.title.capitalize())}</h2>{html_table(table.rows)}</section>"


def _task_row(task: Mapping[str, Any]) -> tuple[str, ...]:
    known = [sample for sample in task["samples"] if not sample.get("lost")]
    causes = Counter(sample["cause"] for sample in known if "cause" in sample)
    partial = sum(sample["partial"] for sample in known) / len(known) if known else 0.0
    return (
        task["task"],
        task["category"].replace("_", " "),
        f"{sum(sample['success'] for sample in known)} of {len(known)}",
        f"{partial:.0%}" if known else NONE,
        ", ".join(f"{cause.replace('_', ' ')} {count}" for cause, count in sorted(causes.items())),
    )


def page_style() -> str:
    """Return the CSS of a page with ``picture_section``: its frame, and the plan views."""
    return files("embomatrix.trainer.evaluation").joinpath("page.css").read_text(encoding="utf-8")


def picture_section(picture: Picture, title: str) -> str:
    """Return a section of half the page's width: verdict, instruction, plan view and the plan step by step."""
    verdict, task = picture.verdict, picture.task
    outcome = "success" if verdict.success else (verdict.cause or "").replace("_", " ")
    items = []
    for number, line in enumerate(picture.lines, start=1):
        why = f"<small>{html.escape(verdict.sentence)}</small>" if number == verdict.step else ""
        items.append(f'<li class="{css_class(verdict, number)}">{html.escape(line)}{why}</li>')
    kind = "ok" if verdict.success else "bad"
    return (
        f'<section class="half plan"><h3>{html.escape(title)}</h3>'
        f'<p><span class="verdict {kind}">{html.escape(outcome)}</span> {html.escape(task.instruction)}</p>'
        f'<div class="scroll">{plan_view(picture.scene, task, picture.plan, verdict)}</div>'
        f"<ol>{''.join(items)}</ol></section>"
    )
