"""Paper's table of success on benchmarks before and after GRPO, from reports of `embomatrix eval`."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Final

from embomatrix.bench.report.page import table
from embomatrix.pages.figures import Better, Figure
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.evaluation.table import ScoreRow, head
from embomatrix.trainer.evaluation.table import table as table_rows

_FIGURE_NAMES: Final = {"eai": "eai_world"}
"""Figure names of benchmarks with ambiguous names: EAI's tasks in our world are not EAI's own benchmark."""


@dataclass(frozen=True, slots=True)
class PolicyStage:
    """Policy of a run after one stage of training."""

    label: str
    policy: Path

    def report(self, run: Path, bench: str) -> Path:
        """Path of the report of `embomatrix eval` on a benchmark."""
        return run / "benchmarks" / file_name(bench) / file_name(self.label) / "report.json"


def bench_table(
    run: Path, bench: str, stages: Sequence[PolicyStage]
) -> tuple[tuple[str, ...], tuple[Figure, ...]]:
    """Return lines of Markdown with one row for each stage, and the figures.

    Raise TrainerError if a report is missing or damaged.
    """
    reports = []
    for stage in stages:
        path = stage.report(run, bench)
        try:
            reports.append(json.loads(path.read_bytes()))
        except (OSError, ValueError) as error:
            raise TrainerError(
                f"{path} is no report of `embomatrix eval` ({error}): evaluate again"
            ) from error
    rows = [ScoreRow(stage.label, report) for stage, report in zip(stages, reports, strict=True)]
    name = re.sub(r"[^a-z0-9]+", "_", file_name(bench).lower())
    figures = tuple(
        Figure(
            f"{_FIGURE_NAMES.get(name, name)}_success{when}",
            report["overall"]["success"]["value"],
            "",
            Better.HIGHER,
            report["samples"],
        )
        for when, report in zip(("_before", ""), reports, strict=True)
    )
    return (f"`{file_name(bench)}`", "", *table(head(reports[0]), table_rows(rows, "success")), ""), figures


def benchmark_section(run: Path, tables: Sequence[str], commit: str, today: date) -> str:
    """Section in Markdown with the lines of all tables."""
    about = f"The run `{run.name}`, evaluated at commit `{commit}`. Success in percent, 95 % intervals over tasks."
    return "\n".join([f"## {today.isoformat()}: benchmarks before and after GRPO", "", about, "", *tables])


def file_name(text: str) -> str:
    """Last part of a benchmark's name or path, with characters that a file name may hold."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text.rstrip("/").rpartition("/")[2]).strip("-.") or "bench"
