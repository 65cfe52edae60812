"""Markdown section of an experiment: configuration, success, curves, times. Sections are appended, never replaced."""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, Final

from embomatrix.bench.experiments.design import Design
from embomatrix.bench.experiments.findings import BINS, ArmFindings, Run, by_task, curve, difference
from embomatrix.bench.report.page import table
from embomatrix.trainer.evaluation.intervals import bootstrap, paired_difference
from embomatrix.trainer.lifecycle.stopwatch import Activity
from embomatrix.world.whole_file import write_whole

WIDTH: Final = 128
HEAD: Final = (
    "# Experiments\n\n`embomatrix experiment` writes each section from the files of its runs. Remarks below the tables are "
    "written by hand.\nSections are never removed, including those of failed experiments.\n"
)
NOTHING: Final = "–"
"""Cell without a value: no task was held out, no step has the metric, or an older run did not record its memory."""
CURVES: Final = (
    ("success", "success of training plans"),
    ("zero_variance_groups", "zero-variance groups"),
    ("entropy", "entropy of a token, nats"),
    ("plan_steps", "executed steps of a plan"),
)
"""Metrics that the section shows along a run."""


def learning_section(
    design: Design, arms: Sequence[ArmFindings], machine: Mapping[str, Any], commit: str, today: date
) -> str:
    """Section of an experiment with arms."""
    return "\n".join(
        [
            f"## {today.isoformat()}: {design.name}",
            "",
            _paragraph(_configuration(design, machine, commit)),
            "",
            *table(("arm", "settings"), ((arm.name, _settings(arm.settings)) for arm in design.arms)),
            "",
            "Success on held-out tasks with 95 % bootstrap intervals over tasks. Rows named *all* average each task over the",
            "seeds.",
            "",
            *table(
                ("arm", "seed", "steps", "rollouts", "lost", "after imitation", "after GRPO", "gain"),
                [row for arm in arms for row in _success_rows(arm)],
            ),
            "",
            *_differences(arms),
            f"Training curves: each run is divided into {BINS} equal parts in order of time, and each column is the mean of",
            "one part.",
            "",
            *table(
                ("arm", "seed", "metric", *(str(number) for number in range(1, BINS + 1))),
                [row for arm in arms for run in arm.runs for row in _curve_rows(run)],
            ),
            "",
            "Share of a GRPO step's time by phase; *overhead* is everything except sampling and update. *memory* is the peak",
            "of the trainer's process.",
            "",
            *table(
                ("arm", "seed", "seconds a step", "sampling", "update", "waiting", "overhead", "memory"),
                [_time_row(run) for arm in arms for run in arm.runs],
            ),
            "",
        ]
    )


def add_section(page: Path, section: str) -> None:
    """Append a section to a page; a missing page is created with its head. Raise OSError."""
    before = page.read_text(encoding="utf-8") if page.exists() else HEAD
    page.parent.mkdir(parents=True, exist_ok=True)
    write_whole(page, f"{before.rstrip()}\n\n{section.rstrip()}\n".encode())


def _configuration(design: Design, machine: Mapping[str, Any], commit: str) -> str:
    shared = f", all with {_settings(design.shared)}" if design.shared else ""
    return (
        f"Dataset {design.dataset}; model `{design.model}`; seeds {', '.join(map(str, design.seeds))}; at most "
        f"{design.imitation} of imitation{_stop(design.patience)}; {design.grpo} of GRPO per "
        f"arm{shared}; {design.threads} threads. Commit `{commit}`, "
        f"{machine['cores']} cores ({machine['cpu']}), load {machine['load_before']} when the command started."
    )


def _stop(patience: int) -> str:
    if not patience:
        return ""
    return f", stopped after {patience} measurements without a lower validation loss"


def _success_rows(arm: ArmFindings) -> Iterable[tuple[str, ...]]:
    for run in arm.runs:
        outcome = run.outcome
        then, now = by_task(outcome.before), by_task(outcome.after)
        gain = paired_difference(then, now)
        yield (
            arm.name,
            str(run.seed),
            str(outcome.steps),
            f"{outcome.rollouts:,}",
            str(outcome.lost),
            *(f"{bootstrap(list(rates.values())).value:.1%}" if rates else NOTHING for rates in (then, now)),
            gain.as_percent() if now else NOTHING,
        )
    if len(arm.runs) > 1:
        yield (
            arm.name,
            "all",
            *("",) * 3,
            arm.before.as_percent(),
            arm.after.as_percent(),
            arm.gain.as_percent(),
        )


def _differences(arms: Sequence[ArmFindings]) -> list[str]:
    """Table of the other arms' differences to the first one; nothing for a single arm."""
    if len(arms) < 2:
        return []
    first, *others = arms
    return [
        f"Success after GRPO minus that of the arm *{first.name}*, paired by seed and task.",
        "",
        *table(("arm", "difference"), [(arm.name, difference(first, arm).as_percent()) for arm in others]),
        "",
    ]


def _curve_rows(run: Run) -> Iterable[tuple[str, ...]]:
    for key, title in CURVES:
        values = [NOTHING if math.isnan(value) else f"{value:.2f}" for value in curve(run, key)]
        yield (run.arm, str(run.seed), title, *values, *("",) * (BINS - len(values)))


def _time_row(run: Run) -> tuple[str, ...]:
    outcome = run.outcome
    total = outcome.grpo_s or 1.0
    activities = (Activity.SAMPLING, Activity.UPDATE, Activity.WAITING)
    shares = [outcome.spent_s.get(activity, 0.0) / total for activity in activities]
    return (
        run.arm,
        str(run.seed),
        f"{total / max(1, outcome.steps):.2f}",
        *(f"{share:.1%}" for share in shares),
        f"{outcome.shares.overhead:.1%}",
        f"{outcome.peak_mb:,.0f} MB" if outcome.peak_mb else NOTHING,
    )


def _settings(settings: Mapping[str, str]) -> str:
    return ", ".join(f"`{key} = {value}`" for key, value in settings.items()) or "defaults"


def _paragraph(text: str) -> str:
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)
