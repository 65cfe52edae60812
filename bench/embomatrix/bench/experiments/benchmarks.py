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


@dataclass(frozen=True, slots=True)
class BenchRows:
    """Part of the table for one benchmark: column titles, one line for each stage, and the figures."""

    bench: str
    head: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    figures: tuple[Figure, ...]


def bench_rows(run: Path, bench: str, stages: Sequence[PolicyStage]) -> BenchRows:
    """Read the reports of a benchmark. Raise TrainerError if one is missing or damaged."""
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
    figures = [
        Figure(
            f"{_FIGURE_NAMES.get(name, name)}_success{when}",
            report["overall"]["success"]["value"],
            "",
            Better.HIGHER,
            report["samples"],
        )
        for when, report in zip(("_before", ""), reports, strict=True)
    ]
    return BenchRows(file_name(bench), head(reports[0]), tuple(table_rows(rows, "success")), tuple(figures))


def benchmark_section(run: Path, found: Sequence[BenchRows], commit: str, today: date) -> str:
    """Section in Markdown."""
    lines = [f"## {today.isoformat()}: benchmarks before and after GRPO", ""]
    lines += [
        f"The run `{run.name}`, evaluated at commit `{commit}`. Success in percent, 95 % intervals over tasks.",
        "",
    ]
    for each in found:
        lines += [f"`{each.bench}`", ""]
        lines += table(each.head, each.lines)
        lines.append("")
    return "\n".join(lines)


def file_name(text: str) -> str:
    """Last part of a benchmark's name or path, with characters that a file name may hold."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text.rstrip("/").rpartition("/")[2]).strip("-.") or "bench"
