"""Reports of scenes as a table and as lines for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rich.table import Table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.factory.scenes.report import SceneReport


TABLE_COLUMNS: Final = 100
"""Characters that ``report_table`` needs: a file or a narrow terminal shall not cut its figures off."""


def report_table(reports: Sequence[SceneReport]) -> Table:
    """One row a scene, and a row of sums: times are CPU seconds, ``placed`` counts of what the inventory lists."""
    table = Table(box=None, pad_edge=False)
    table.add_column("scene", no_wrap=True)
    for name in ("build s", "rooms", "placed", "listed", "movable", "stable", "wrong"):
        table.add_column(name, justify="right", no_wrap=True)
    for report in reports:
        if report.error:
            table.add_row(_name(report), "not built")
            continue
        table.add_row(*_row(_name(report), [report]), f"{report.stable:.1%}", str(len(report.problems)))
    if len(reports) > 1:
        sums = _row(f"{len(reports)} scenes", reports)
        table.add_row(*sums, "", str(sum(len(report.problems) for report in reports)), style="bold")
    return table


def problem_lines(reports: Sequence[SceneReport]) -> Iterator[str]:
    """A line for every problem, and for every scene that wasn't built."""
    for report in reports:
        if report.error:
            yield f"{_name(report)}: {report.error}"
        for problem in report.problems:
            yield f"{_name(report)}: {problem.kind}: {', '.join(problem.names)}: {problem.detail}"


def _name(report: SceneReport) -> str:
    return f"{report.scene_id} #{report.seed}" if report.seed else report.scene_id


def _row(name: str, reports: Sequence[SceneReport]) -> tuple[str, ...]:
    counts = ((r.rooms, r.placed, r.listed, r.movable) for r in reports)
    sums = (str(sum(column)) for column in zip(*counts, strict=True))
    return (name, f"{sum(r.build_s for r in reports):.1f}", *sums)
