"""The paper's table: success of a policy on benchmarks before and after GRPO, as `embomatrix eval` measured it."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.pages.figures import Better, Figure
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.evaluation.table import ScoreRow, head
from embomatrix.trainer.evaluation.table import table as table_rows

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import date
    from pathlib import Path

_FIGURE_NAMES: Final = {"eai": "eai_world"}
"""Of benchmarks whose own name could be mistaken for another's: EAI's tasks in our world are not EAI's own."""


@dataclass(frozen=True, slots=True)
class PolicyStage:
    """A policy of a run, by what it has been through."""

    label: str
    policy: Path

    def report(self, run: Path, bench: str) -> Path:
        """Where `embomatrix eval` puts its report on a benchmark."""
        return run / "benchmarks" / file_name(bench) / file_name(self.label) / "report.json"


@dataclass(frozen=True, slots=True)
class BenchRows:
    """One benchmark's part of the table: titles of its columns, a line for each stage, and the figures."""

    bench: str
    head: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    figures: tuple[Figure, ...]


def bench_rows(run: Path, bench: str, stages: Sequence[PolicyStage]) -> BenchRows:
    """Read the reports of a benchmark. Raises TrainerError where one is missing or damaged."""
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
    """The section in Markdown."""
    lines = [f"## {today.isoformat()}: benchmarks before and after GRPO", ""]
    lines += [
        f"The run `{run.name}`, evaluated at commit `{commit}`. Success in percent, 95 % intervals over tasks.",
        "",
    ]
    for each in found:
        lines += [f"`{each.bench}`", ""]
        lines += ["| " + " | ".join(row) + " |" for row in (each.head, ["---"] * len(each.head), *each.lines)]
        lines.append("")
    return "\n".join(lines)


def file_name(text: str) -> str:
    """The last part of a benchmark's name or path, fit for a file's name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text.rstrip("/").rpartition("/")[2]).strip("-.") or "bench"
