"""HTML page of an evaluation: one file without scripts or external resources."""

import html
import string
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import PurePath
from typing import Any, Final

from embomatrix.pages.head import page_head
from embomatrix.trainer.evaluation.pictures import Picture
from embomatrix.trainer.evaluation.plan_view import ExecutedPlan, plan_view
from embomatrix.trainer.evaluation.table import (
    COLUMNS,
    INTERVALS,
    NONE,
    ScoreRow,
    cause_rows,
    head,
    pass_rows,
    percent,
    table,
)

_CHART_W: Final = 560
_LINE_H: Final = 44
_LABEL_W: Final = 130
_VALUE_W: Final = 120


def evaluation_page(
    report: Mapping[str, Any], pictures: Sequence[Picture], beside: Sequence[ScoreRow] = ()
) -> str:
    """Return the page of a report, with the rows of other reports on the same tasks below its own."""
    template = files("embomatrix.trainer.evaluation").joinpath("page.html").read_text(encoding="utf-8")
    setup = report["setup"]
    rows = [ScoreRow(setup["model"], report), *beside]
    title = f"{setup['model']} on {PurePath(setup['bench']).name}"
    return string.Template(template).substitute(
        head=page_head(f"{title} · EmboMatrix evaluation"),
        title=html.escape(title),
        about=html.escape(_about(report)),
        success=_table(head(report), table(rows, "success")),
        partial=_table(head(report), table(rows, "partial")),
        notes=_notes(report),
        chart=_chart(report),
        passes=_table(("", *head(report)[1:]), pass_rows(report)),
        causes=_causes(report),
        pictures="".join(_picture(picture) for picture in pictures),
        count=report["tasks"],
        tasks=_table(
            ("task", "category", "succeeded", "partial", "causes"),
            [_task_row(task) for task in report["verdicts"]],
        ),
        intervals=html.escape(INTERVALS),
        digest=html.escape(setup["bench_digest"].removeprefix("sha256:")[:16]),
    )


def _about(report: Mapping[str, Any]) -> str:
    setup = report["setup"]
    lost = f" · {report['lost']} plans lost to the infrastructure" if report["lost"] else ""
    return (
        f"{report['tasks']} tasks ({setup['split']}) · {setup['samples']} samples each · temperature "
        f"{setup['temperature']:g} · plans as {setup['codec']}{lost}"
    )


def _table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    top = "".join(f"<th>{html.escape(title)}</th>" for title in titles)
    body = "".join("<tr>" + "".join(f"<td>{_cell(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<tr>{top}</tr>{body}"


def _cell(text: str) -> str:
    """Highlight the estimate against its interval."""
    value, bracket, rest = html.escape(text).partition(" [")
    return f"<b>{value}</b> <span>[{rest}</span>" if bracket else value


def _notes(report: Mapping[str, Any]) -> str:
    """Additional figures: success over all tasks, and the exam's own figures."""
    others = "".join(
        f'<p class="note">{html.escape(name)}: {percent(found)} %.</p>'
        for name, found in report["others"].items()
    )
    if not report["tasks_failed_by_rule"]:
        return others
    return others + (
        f'<p class="note">{report["tasks_failed_by_rule"]} more tasks can\'t be expressed with these skills, or were rejected. '
        f"If they count as failed: {percent(report['success_over_all'])} %.</p>"
    )


def _chart(report: Mapping[str, Any]) -> str:
    """Bars of success with intervals, and rings for partial credit."""
    groups = [("all tasks", report["overall"])]
    groups += [
        (title, report["categories"][category.value])
        for category, title in COLUMNS.items()
        if category.value in report["categories"]
    ]
    width = _CHART_W - _LABEL_W - _VALUE_W
    shapes = []
    for at, (title, figures) in enumerate(groups):
        success, partial = figures["success"], figures["partial"]
        y = at * _LINE_H + 12
        shapes.append(f'<text x="0" y="{y + 14}">{html.escape(title)}</text>')
        shapes.append(f'<path class="axis" d="M{_LABEL_W} {y + 20}h{width}"/>')
        if success["value"] is None:
            continue
        value, low, high = (_LABEL_W + width * success[name] for name in ("value", "low", "high"))
        shapes.append(
            f'<rect class="value" x="{_LABEL_W}" y="{y}" width="{value - _LABEL_W:.1f}" height="18" rx="2"/>'
            f'<path class="span" d="M{low:.1f} {y + 9}H{high:.1f}M{low:.1f} {y + 4}v10M{high:.1f} {y + 4}v10"/>'
            f'<circle cx="{_LABEL_W + width * partial["value"]:.1f}" cy="{y + 9}" r="4" fill="none" class="span"/>'
            f'<text class="faint" x="{_CHART_W}" y="{y + 14}" text-anchor="end">{percent(success)}</text>'
        )
    height = len(groups) * _LINE_H
    return (
        f'<svg class="chart" viewBox="0 0 {_CHART_W} {height}" role="img" aria-label="Success by category">'
        f'{"".join(shapes)}</svg><p class="note">Bar: success with its interval. Ring: partial credit.</p>'
    )


def _causes(report: Mapping[str, Any]) -> str:
    rows = cause_rows(report)
    if not rows:
        return '<p class="note">No plan failed.</p>'
    most = max(int(count) for _, count, _, _ in rows)
    body = "".join(
        f"<tr><td>{html.escape(name.replace('_', ' '))}</td><td>{count}</td><td>{share}</td>"
        f'<td><div class="bar"><i style="width:{100 * int(count) / most:.0f}%"></i></div></td>'
        f'<td class="words">{html.escape(meaning)}</td></tr>'
        for name, count, share, meaning in rows
    )
    top = "<tr><th>cause</th><th>plans</th><th>share</th><th></th><th>meaning</th></tr>"
    return f'<div class="scroll"><table>{top}{body}</table></div>'


def _task_row(task: Mapping[str, Any]) -> tuple[str, ...]:
    known = [sample for sample in task["samples"] if not sample.get("lost")]
    causes: dict[str, int] = {}
    for sample in known:
        if "cause" in sample:
            causes[sample["cause"]] = causes.get(sample["cause"], 0) + 1
    partial = sum(sample["partial"] for sample in known) / len(known) if known else 0.0
    return (
        task["task"],
        task["category"].replace("_", " "),
        f"{sum(sample['success'] for sample in known)} of {len(known)}",
        f"{partial:.0%}" if known else NONE,
        ", ".join(f"{cause.replace('_', ' ')} {count}" for cause, count in sorted(causes.items())),
    )


def _picture(picture: Picture) -> str:
    verdict, task = picture.verdict, picture.task
    title = "success" if verdict.success else (verdict.cause or "").replace("_", " ")
    drawn = ExecutedPlan(picture.plan, verdict.done, failed=verdict.step > 0)
    items = []
    for number, line in enumerate(picture.lines, start=1):
        failed = number == verdict.step
        kind = "bad" if failed else "ok" if number <= verdict.done else "not"
        why = f"<small>{html.escape(verdict.sentence)}</small>" if failed else ""
        items.append(f'<li class="{kind}">{html.escape(line)}{why}</li>')
    kind = "ok" if verdict.success else "bad"
    return (
        f'<section class="half plan"><h3>{html.escape(task.task_id)}</h3>'
        f'<p><span class="verdict {kind}">{html.escape(title)}</span> {html.escape(task.instruction)}</p>'
        f"{plan_view(picture.scene, task, drawn)}<ol>{''.join(items)}</ol></section>"
    )
