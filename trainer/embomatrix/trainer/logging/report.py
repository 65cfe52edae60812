"""HTML report of a run: learning curves, success before and after GRPO, and time by activity, in one file."""

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from embomatrix.pages.head import html_table, page_head
from embomatrix.rpc.wire.values import RunStats
from embomatrix.trainer.evaluation.held_out import HeldOutEvaluation, improvement
from embomatrix.trainer.logging.outcome import RunOutcome, TaskRate

REPORT = "report.html"
_WIDTH, _HEIGHT, _MARGIN = 640, 220, 44
_CURVES = (
    ("reward", "mean reward of a step", "#1b6ca8"),
    ("success", "success rate of rollouts", "#2a7f3f"),
    ("plan_steps", "executed steps per plan", "#8a5a00"),
    ("entropy", "entropy of a token (nats)", "#7a3b8f"),
    ("zero_variance_groups", "zero-variance groups", "#a83232"),
)


@dataclass(frozen=True)
class TrainingSummary:
    """Results of a finished run. ``checkpoint`` is the newest; ``before`` and ``after`` are None without held-out tasks."""

    outcome: RunOutcome
    before: HeldOutEvaluation | None
    after: HeldOutEvaluation | None
    stats: RunStats
    checkpoint: Path
    report: Path


def time_rows(outcome: RunOutcome) -> list[tuple[str, float, float]]:
    """Rows of activity, seconds and share of the wall clock, including a row for the remaining time."""
    total = max(outcome.wall_s, 1e-9)
    rows = [(name, spent, spent / total) for name, spent in outcome.spent_s.items()]
    rest = max(0.0, outcome.wall_s - sum(outcome.spent_s.values()))
    return [*rows, ("other", rest, rest / total)]


def success_rows(summary: TrainingSummary) -> list[tuple[str, str, str, str]]:
    """Rows of category, success before, success after, and paired difference, each with its interval."""
    if summary.before is None or summary.after is None:
        return []
    rows = []
    for category in ("", *summary.after.categories):
        change = improvement(_only(summary.before, category), _only(summary.after, category))
        rows.append(
            (
                category or "all tasks",
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


def prewarm_share(stats: RunStats) -> float:
    """Share of announced scenes that were warm when needed, 0 without any."""
    asked = stats.prewarm_hits + stats.prewarm_misses
    return stats.prewarm_hits / asked if asked else 0.0


def write_report(summary: TrainingSummary, metrics: Sequence[Mapping[str, Any]], machine: str) -> None:
    outcome = summary.outcome
    times = [(name, f"{spent:.1f}", f"{share:.0%}") for name, spent, share in time_rows(outcome)]
    parts = [
        f"<h1>Training of {html.escape(outcome.model)}</h1>",
        f"<p>{outcome.imitation_steps} imitation steps, {outcome.steps} GRPO steps, {outcome.rollouts} rollouts; "
        f"{outcome.lost} rollouts lost to the infrastructure and masked; "
        f"{prewarm_share(summary.stats):.0%} of announced scenes warm in time, "
        f"{summary.stats.shared_share:.0%} of the steps shared. Machine: {html.escape(machine)}.</p>",
        "<h2>Success on held-out tasks</h2>",
        html_table([("tasks", "before GRPO", "after", "difference"), *success_rows(summary)])
        if summary.after
        else "<p>The dataset has no held-out tasks.</p>",
        "<p>95 % bootstrap intervals over tasks.</p>",
        "<h2>Learning curves</h2>",
        *(_curve([row[key] for row in metrics], title, colour) for key, title, colour in _CURVES),
        "<h2>Where the time went</h2>",
        html_table([("activity", "seconds", "share"), *times]),
        f"<p>Checkpoint: <code>{html.escape(str(summary.checkpoint))}</code></p>",
    ]
    style = "body { max-width: 720px; margin: 2rem auto; padding: 0 1rem; } svg { display: block; fill: currentColor; }"
    page = f"{page_head('Training report')}<style>{style}</style></head><body>{''.join(parts)}</body></html>"
    summary.report.write_text(page, encoding="utf-8")


def _curve(series: Sequence[float | None], title: str, colour: str) -> str:
    """Inline SVG with raw values (thin) and their moving average (bold). None values are skipped."""
    steps = [at for at, value in enumerate(series) if value is not None]
    values = [value for value in series if value is not None]
    if not values:
        return ""
    low, high = min(*values, 0.0), max(values)
    high = high if high > low else low + 1.0
    window = max(1, len(values) // 20)
    means = [sum(values[max(0, at - window + 1) : at + 1]) / min(at + 1, window) for at in range(len(values))]

    def points(line: Sequence[float]) -> str:
        across = (_WIDTH - 2 * _MARGIN) / max(1, len(series) - 1)
        up = (_HEIGHT - 2 * _MARGIN) / (high - low)
        return " ".join(
            f"{_MARGIN + at * across:.1f},{_HEIGHT - _MARGIN - (value - low) * up:.1f}"
            for at, value in zip(steps, line, strict=True)
        )

    text = 'font-size="12" opacity=".7"'
    return (
        f'<svg width="{_WIDTH}" height="{_HEIGHT}" role="img" aria-label="{html.escape(title)}">'
        f'<text x="{_MARGIN}" y="24" font-size="14">{html.escape(title)}</text>'
        f'<path d="M{_MARGIN} {_MARGIN}V{_HEIGHT - _MARGIN}H{_WIDTH - _MARGIN}" fill="none" stroke="#999"/>'
        f'<text x="4" y="{_MARGIN + 4}" {text}>{high:.3g}</text>'
        f'<text x="4" y="{_HEIGHT - _MARGIN}" {text}>{low:.3g}</text>'
        f'<text x="{_WIDTH - _MARGIN}" y="{_HEIGHT - _MARGIN + 16}" {text} text-anchor="end">step {len(series)}</text>'
        f'<polyline points="{points(values)}" fill="none" stroke="{colour}" stroke-opacity=".3"/>'
        f'<polyline points="{points(means)}" fill="none" stroke="{colour}" stroke-width="2"/></svg>'
    )
