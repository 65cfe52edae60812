"""Page of benchmarks: tables between marks are generated anew, all other text is kept as its authors wrote it."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Final

from embomatrix.bench.report.figures import BenchError, BenchResult, is_shared
from embomatrix.pages.figures import Figure, shown

END: Final = "<!-- end of figures -->"
_BLOCK: Final = re.compile(r"<!-- figures: ([a-z-]+) -->\n.*?<!-- end of figures -->", re.DOTALL)
_MARK: Final = re.compile(r"<!-- (?:figures: [a-z-]+|end of figures) -->")
TITLE: Final = "# Benchmarks\n"
CONTEST: Final = "contest, "
"""Prefix of the figures that the table of peers shows."""
ABLATION_ROWS: Final = {
    "naive": 3.48,
    "cached": 0.85,
    "scheduler": 0.14,
    "dispatcher": 0.07,
}
"""Rows of the paper's table on simulation latency, with its seconds."""
ABLATION_WORDS: Final = ("naive", "+ pre-cached execution", "+ Resource-Scheduler", "+ Task-Dispatcher")


def render_page(results: Sequence[BenchResult], page: str) -> str:
    """Replace the blocks of the measured benchmarks and append those that the page lacks.

    ``page`` is the Markdown to update, empty for a new page. Raise BenchError if it has no marks, or they don't pair.
    """
    check_page(page)
    page = page or TITLE
    for name, lines in chain.from_iterable(map(_blocks, results)):
        block = "\n".join([f"<!-- figures: {name} -->", "", *lines, "", END])
        known = [found for found in _BLOCK.finditer(page) if found[1] == name]
        if known:
            page = page[: known[0].start()] + block + page[known[0].end() :]
        else:
            page = f"{page.rstrip()}\n\n## {name.capitalize()}\n\n{block}\n"
    return page


def check_page(page: str) -> None:
    """Raise BenchError if the page can't be updated without losing text."""
    marks = len(_MARK.findall(page))
    if page.strip() and not (marks or page.strip() == TITLE.strip()):
        raise BenchError(
            "the page has no marks '<!-- figures: NAME -->': expected a page that this command wrote; name "
            "another file with --out, or add the marks where the tables belong"
        )
    if marks != 2 * len(_BLOCK.findall(page)):
        raise BenchError(
            f"the page has {marks} marks that do not pair: expected '<!-- figures: NAME -->' and '{END}' in turn"
        )


def _blocks(result: BenchResult) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and lines of each block of a result."""
    if ablation := ablation_lines(result.figures):
        yield "ablation", ablation
    if peers := peer_lines(result.figures):
        yield "peers", peers
    figures = [figure for figure in result.figures if not figure.name.startswith(CONTEST)]
    yield result.bench, [*_provenance(result), "", *_figure_lines(figures)]


def _provenance(result: BenchResult) -> list[str]:
    machine = result.machine
    known = ("cpu", "memory_gb", "system", "speed", "gpu", "python", "pybullet", "numpy", "platform")
    details = [f"{name.replace('_', ' ')} {machine[name]}" for name in known if machine.get(name)]
    shared = (
        " The machine was shared: absolute times would be lower on a dedicated machine; ratios change less."
    )
    return [
        f"Commit `{result.commit}`, {machine['cores']} cores, load {machine['load_before']} before."
        + (shared if is_shared(machine) else ""),
        *([f"Machine: {', '.join(details)}."] if details else []),
    ]


def _figure_lines(figures: Sequence[Figure]) -> list[str]:
    rows = (
        (figure.name, f"{figure.formatted} {figure.unit}", figure.bound, figure.verdict, f"{figure.n:,}")
        for figure in figures
    )
    lines = table(("figure", "value", "goal", "", "n"), rows)
    short = [figure.name for figure in figures if figure.verdict not in ("", "reached")]
    if any(figure.goal is not None for figure in figures):
        lines += ["", f"Goals missed: {'; '.join(short)}." if short else "Every goal is reached."]
    return lines


def ablation_lines(figures: Sequence[Figure]) -> list[str]:
    """Return the paper's table beside ours, or no lines if the ablation was not measured."""
    values = {figure.name: figure.value for figure in figures}
    if "ablation_naive_ms" not in values:
        return []

    def cells(suffix: str, row: str) -> tuple[str, str]:
        first, value = values.get(f"ablation_naive{suffix}"), values.get(f"ablation_{row}{suffix}")
        return (shown(value), f"{shown(first / value)} ×") if first and value else ("", "")

    rows = (
        (
            words,
            f"{paper_s:g}",
            f"{ABLATION_ROWS['naive'] / paper_s:.3g} ×",
            *cells("_ms", row),
            *cells("_slow_ms", row),
        )
        for words, (row, paper_s) in zip(ABLATION_WORDS, ABLATION_ROWS.items(), strict=True)
    )
    return table(
        ("", "paper, s", "ratio", "ours, ms", "ratio", "ours with loading slowed, ms", "ratio"), rows
    )


def peer_lines(figures: Sequence[Figure]) -> list[str]:
    """Return a table of our cluster and its peers, or no lines if they were not measured."""
    values: dict[str, dict[str, float]] = {}
    for figure in figures:
        if figure.name.startswith(CONTEST):
            system, _, column = figure.name.removeprefix(CONTEST).partition(": ")
            values.setdefault(system, {})[column] = figure.value
    columns = list(dict.fromkeys(column for row in values.values() for column in row))
    leads = {figure.name: shown(figure.value) for figure in figures if figure.name.startswith("vs_")}
    rows = (
        (system.replace("_", " "), *_cells(row, columns), leads.get(f"vs_{system}", ""))
        for system, row in values.items()
    )
    return table(("", *columns, "ours over it"), rows) if values else []


def _cells(row: Mapping[str, float], columns: Iterable[str]) -> list[str]:
    return [shown(row[column]) if column in row else "" for column in columns]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A table in Markdown: the first column to the left, the others to the right."""
    marks = ["---", *["---:"] * (len(head) - 1)]
    escaped = ([cell.replace("|", "\\|") for cell in row] for row in rows)
    return [f"| {' | '.join(row)} |" for row in (head, marks, *escaped)]
