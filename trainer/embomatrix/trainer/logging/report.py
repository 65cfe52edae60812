"""HTML report of a run: what changed on held-out tasks and why plans fail, curves, and where the time went, in one file."""

from __future__ import annotations

import html
import platform
import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import torch

from embomatrix.host.code_version import commit_here
from embomatrix.host.limits import usable_cores
from embomatrix.pages.head import html_table, page_head
from embomatrix.rpc.wire.values import RunStats
from embomatrix.trainer.evaluation.held_out import HeldOutEvaluation, improvement
from embomatrix.trainer.evaluation.page import page_style, picture_section
from embomatrix.trainer.evaluation.taxonomy import MEANINGS, Cause
from embomatrix.trainer.logging.curves import step_curve, success_curve
from embomatrix.trainer.logging.evaluations import AFTER, BEFORE, RecordedEvaluation
from embomatrix.trainer.logging.examples import examples_of
from embomatrix.trainer.logging.outcome import RunOutcome, TaskRate
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from embomatrix.trainer.data.tasks import TaskSet
    from embomatrix.world.task import TaskCategory

REPORT = "report.html"
_CURVES: Final = (
    ("reward", "mean reward of a step", False),
    ("success", "success of training rollouts", True),
    ("plan_steps", "executed steps per plan", False),
    ("entropy", "entropy of a token (nats)", False),
    ("kl", "KL to the reference policy (nats)", False),
    ("zero_variance_groups", "zero-variance groups", True),
)
"""Figures of a step: name, label, and whether it is a share."""


@dataclass(frozen=True)
class TrainingSummary:
    """Results of a finished run. ``checkpoint`` is the newest; ``before`` and ``after`` are None without held-out tasks."""

    outcome: RunOutcome
    before: HeldOutEvaluation | None
    after: HeldOutEvaluation | None
    stats: RunStats
    checkpoint: Path
    report: Path


@dataclass(frozen=True)
class TrainedOn:
    """Tasks that a run trained on, a digest of them, and the run's seed."""

    tasks: TaskSet
    digest: str
    seed: int


def time_rows(outcome: RunOutcome) -> list[tuple[str, float, float]]:
    """Rows of activity, seconds and share of the wall clock, including a row for the remaining time."""
    total = max(outcome.wall_s, 1e-9)
    rows = [(name, spent, spent / total) for name, spent in outcome.spent_s.items()]
    rest = max(0.0, outcome.wall_s - sum(outcome.spent_s.values()))
    return [*rows, ("other", rest, rest / total)]


def success_rows(summary: TrainingSummary) -> list[tuple[str, str, str, str, str]]:
    """Rows of category, number of tasks, success before, success after, and paired difference, each with its interval."""
    if summary.before is None or summary.after is None:
        return []
    rows = []
    for category in ("", *summary.after.categories):
        change = improvement(_only(summary.before, category), _only(summary.after, category))
        rows.append(
            (
                (category or "all").replace("_", " "),
                str(len(_only(summary.after, category).scores)),
                summary.before.success(category).as_percent(),
                summary.after.success(category).as_percent(),
                change.as_percent(),
            )
        )
    return rows


def rates_of(evaluation: HeldOutEvaluation | None) -> tuple[TaskRate, ...]:
    """Success rate of each task, none without an evaluation."""
    scores = evaluation.scores if evaluation is not None else ()
    return tuple(
        TaskRate(score.task_id, score.category, score.rate if score.samples else None) for score in scores
    )


def _only(evaluation: HeldOutEvaluation, category: str) -> HeldOutEvaluation:
    return type(evaluation)(tuple(s for s in evaluation.scores if category in ("", s.category)))


def prewarm_share(stats: RunStats) -> str:
    """Share of announced scenes that were warm when needed; a dash without any, as in episodes."""
    asked = stats.prewarm_hits + stats.prewarm_misses
    return f"{stats.prewarm_hits / asked:.0%}" if asked else "–"


def write_report(
    summary: TrainingSummary,
    source: TrainedOn,
    metrics: Sequence[Mapping[str, Any]],
    evaluations: Sequence[RecordedEvaluation],
) -> None:
    """Write the page. ``metrics`` are the records of the steps. Raises OSError."""
    template = files("embomatrix.trainer.logging").joinpath("report.html").read_text(encoding="utf-8")
    before, after = (_last(evaluations, label) for label in (BEFORE, AFTER))
    title = f"Training of {summary.outcome.model}"
    page = string.Template(template).substitute(
        head=page_head(title),
        page_style=page_style(),
        title=html.escape(title),
        about=html.escape(_about(summary, source)),
        story=_story(summary),
        curve=_held_out_curve(evaluations, source.tasks),
        causes=_causes(before, after, source.tasks),
        examples=_examples(before, after, source.tasks),
        curves="".join(map(_section_of_curve, _drawn(metrics))),
        times=_times(summary.outcome),
        next=_next_steps(summary, source),
    )
    write_whole(summary.report, page.encode("utf-8"))


def machine_description() -> str:
    """Cores, architecture and versions, for reports."""
    return f"{usable_cores()} cores, {platform.machine()}, Python {platform.python_version()}, torch {torch.__version__}"


def _about(summary: TrainingSummary, source: TrainedOn) -> str:
    """Return date, length, seed, dataset, version and machine of the run in one line."""
    outcome, tasks = summary.outcome, source.tasks
    minutes, seconds = divmod(round(outcome.wall_s), 60)
    dataset = f"{tasks.folder}, " if tasks.folder is not None else ""
    return " · ".join(
        (
            f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
            f"{minutes} min {seconds} s",
            f"seed {source.seed}",
            f"dataset {dataset}{len(tasks.train)} training and {len(tasks.heldout)} held-out tasks, digest "
            f"{source.digest or 'unknown'}",
            f"EmboMatrix {commit_here()}",
            machine_description(),
        )
    )


def _story(summary: TrainingSummary) -> str:
    """Table of success by category, and what the run consisted of in a sentence."""
    outcome, stats = summary.outcome, summary.stats
    rows = success_rows(summary)
    table = (
        html_table([("category", "tasks", "before GRPO", "after GRPO", "difference"), *rows]) if rows else ""
    )
    return (
        f"{table or '<p>The dataset has no held-out tasks.</p>'}"
        f"<p>{outcome.imitation_steps:,} steps of imitation, then {outcome.steps:,} of GRPO with "
        f"{outcome.rollouts:,} rollouts. The infrastructure lost {outcome.lost:,} rollouts, which are left out of the loss. "
        f"Announced scenes that were loaded before their first rollout: {prewarm_share(stats)}. Steps reused from equal "
        f"beginnings of other plans: {stats.shared_share:.0%}.</p>"
    )


def _last(evaluations: Sequence[RecordedEvaluation], label: str) -> RecordedEvaluation | None:
    return next((each for each in reversed(evaluations) if each.label == label and each.answers), None)


def _categories(tasks: TaskSet) -> dict[str, TaskCategory]:
    return {task.task.task_id: task.task.category for task in tasks.heldout}


def _held_out_curve(evaluations: Sequence[RecordedEvaluation], tasks: TaskSet) -> str:
    """Curve of held-out success, empty for fewer than three evaluations: two are in the table."""
    categories = _categories(tasks)
    points = [(each.step, each.board(categories).success().interval) for each in evaluations if each.answers]
    return (
        "<section class='curve'><h2>Held-out success during GRPO</h2>"
        f"<div class='scroll'>{success_curve(points)}</div></section>"
        if len(points) > 2
        else ""
    )


def _causes(before: RecordedEvaluation | None, after: RecordedEvaluation | None, tasks: TaskSet) -> str:
    """Section with the causes of failure before and after GRPO, empty without evaluations."""
    if before is None or after is None:
        return ""
    boards = [each.board(_categories(tasks)) for each in (before, after)]
    counts = [board.causes() for board in boards]
    causes = [cause for cause in Cause if any(found[cause] for found in counts)]
    if not causes:
        return ""
    # The meaning stands below the name, so that a phone shows all columns.
    rows = "".join(
        f"<tr><td>{cause.replace('_', ' ')}<small>{html.escape(MEANINGS[cause])}</small></td>"
        + "".join(
            f"<td>{found[cause] / max(1, board.samples - board.lost):.1%}</td>"
            for board, found in zip(boards, counts, strict=True)
        )
        + "</tr>"
        for cause in causes
    )
    table = f"<table><tr><th>cause</th><th>before GRPO</th><th>after GRPO</th></tr>{rows}</table>"
    note = "Shares of all plans; the first failure of a plan counts."
    return f"<section><h2>Why held-out plans failed</h2>{table}<p>{note}</p></section>"


def _examples(before: RecordedEvaluation | None, after: RecordedEvaluation | None, tasks: TaskSet) -> str:
    """Plans of three tasks before and after GRPO, side by side."""
    if before is None or after is None:
        return ""
    parts = []
    for example in examples_of(before, after, tasks):
        task = example.after.task
        parts += [
            f"<h3 class='task'>{html.escape(task.task_id)}: {example.change}</h3>",
            picture_section(example.before, "before GRPO"),
            picture_section(example.after, "after GRPO"),
        ]
    return "".join(parts)


def _drawn(metrics: Sequence[Mapping[str, Any]]) -> list[str]:
    drawn = [
        step_curve(name, label, [row.get(name) for row in metrics], share=share)
        for name, label, share in _CURVES
    ]
    return [curve for curve in drawn if curve]


def _section_of_curve(curve: str) -> str:
    return f'<section class="half"><div class="scroll">{curve}</div></section>'


def _times(outcome: RunOutcome) -> str:
    """Table of seconds and shares by activity, with a bar for each share."""
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{spent:,.0f}&nbsp;s</td><td>{share:.0%}</td>"
        f'<td><div class="bar"><i style="width:{min(1.0, share):.1%}"></i></div></td></tr>'
        for name, spent, share in time_rows(outcome)
    )
    return f"<table><tr><th>activity</th><th>time</th><th>share</th><th></th></tr>{rows}</table>"


def _next_steps(summary: TrainingSummary, source: TrainedOn) -> str:
    """Commands that use the result."""
    dataset = source.tasks.folder or "DATASET"
    commands = (
        (
            f"embomatrix eval --bench {dataset} --model {summary.report.parent}",
            "scores it on the held-out tasks",
        ),
        (
            f"embomatrix train --resume --dataset {dataset} --out {summary.report.parent} --steps {2 * summary.outcome.steps}",
            "continues the run on a cluster of this machine; --manager and --token name another",
        ),
    )
    lines = (
        f"<li><code>{html.escape(command)}</code> {html.escape(what)}</li>" for command, what in commands
    )
    return f"<ul>{''.join(lines)}</ul>"
