"""Charts of a run's report as SVG. The page sets their colours, for light and dark themes."""

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from embomatrix.rpc.wire.run_log import PhaseSummary, RolloutPhase, RunSeries

SIZE_IN: Final = (6.2, 2.5)
MOST_POINTS: Final = 300
"""Most points of a line at this size."""
INK, GRID, GOOD, BAD, SECOND = "#010101", "#020202", "#030303", "#040404", "#050505"
VARIABLES: Final[Mapping[str, str]] = {
    INK: "var(--soft)",
    GRID: "var(--line)",
    GOOD: "var(--good)",
    BAD: "var(--bad)",
    SECOND: "var(--second)",
}
"""CSS variable that replaces each drawing colour."""
STYLE: Final[dict[Any, Any]] = {
    "svg.fonttype": "none",
    "font.size": 10.0,
    "axes.edgecolor": GRID,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": INK,
    "grid.color": GRID,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def throughput_chart(series: RunSeries) -> str:
    """Draw completed and failed rollouts per second over the run."""
    per_step = max(1, -(-len(series.completed) // MOST_POINTS))
    step_s = series.step_s * per_step

    def rates(counts: Sequence[int]) -> list[float]:
        return [sum(counts[at : at + per_step]) / step_s for at in range(0, len(counts), per_step)]

    completed, failed = rates(series.completed), rates(series.failed)
    with mpl.rc_context(STYLE):
        figure, axes = _chart("rollouts/s")
        times_s = _times(axes, len(completed), step_s)
        axes.fill_between(times_s, completed, step="post", color=GOOD, alpha=0.18, linewidth=0)
        axes.step(times_s, completed, where="post", color=GOOD, linewidth=1.6, label="completed")
        if any(failed):
            axes.step(times_s, failed, where="post", color=BAD, linewidth=1.6, label="failed")
            _legend(axes)
        axes.set_ylim(bottom=0)
        return _svg(figure, "throughput", "Completed rollouts per second over the run")


def busy_chart(shares: Sequence[float], step_s: float) -> str:
    """Draw the share of busy slots over the run."""
    with mpl.rc_context(STYLE):
        figure, axes = _chart("slots at work")
        times_s = _times(axes, len(shares), step_s)
        axes.fill_between(times_s, list(shares), step="post", color=SECOND, alpha=0.18, linewidth=0)
        axes.step(times_s, list(shares), where="post", color=SECOND, linewidth=1.6)
        axes.set_ylim(0, 1.02)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{share:.0%}"))
        return _svg(figure, "busy", "Share of slots at work over the run")


def phase_chart(phases: Mapping[RolloutPhase, PhaseSummary]) -> str:
    """Draw median, 95th and 99th percentile of each phase on a logarithmic axis."""
    with mpl.rc_context(STYLE):
        figure, axes = _chart("")
        for row, phase in enumerate(reversed(RolloutPhase)):
            found = phases[phase]
            # A logarithmic axis has no zero: shorter times are drawn at 0.01 ms.
            points_ms = [max(value * 1e3, 0.01) for value in (found.p50_s, found.p95_s, found.p99_s)]
            axes.plot([points_ms[0], points_ms[2]], [row, row], color=SECOND, linewidth=5, alpha=0.3)
            for value, marker, shown in zip(points_ms, "oD|", ("p50", "p95", "p99"), strict=True):
                label = shown if row == 0 else None
                axes.plot(value, row, marker, color=SECOND, markersize=7, markeredgewidth=1.8, label=label)
        axes.set_xscale("log")
        axes.set_yticks(range(len(RolloutPhase)), [phase.value for phase in reversed(RolloutPhase)])
        axes.set_ylim(-0.6, len(RolloutPhase) - 0.4)
        axes.grid(visible=False, axis="y")
        axes.grid(visible=True, axis="x", linewidth=0.8)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _milliseconds(value)))
        _legend(axes)
        return _svg(figure, "phases", "Quantiles of the phases of a rollout")


def _milliseconds(value_ms: float) -> str:
    return f"{value_ms / 1e3:g} s" if value_ms >= 1e3 else f"{value_ms:g} ms"


def _chart(label: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=SIZE_IN, layout="constrained")
    axes = figure.add_subplot()
    axes.set_ylabel(label)
    axes.grid(visible=True, axis="y", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(length=0)
    return figure, axes


def _legend(axes: Axes) -> None:
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, borderaxespad=0.1)


def _times(axes: Axes, steps: int, step_s: float) -> list[float]:
    """Return the start of each step in seconds, and label the axis in a fitting unit."""
    whole_s = max(steps, 1) * step_s
    unit, name = (3600.0, "h") if whole_s > 3 * 3600 else (60.0, "min") if whole_s > 180 else (1.0, "s")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda at_s, _: f"{at_s / unit:g}"))
    axes.set_xlabel(f"{name} since the run was opened")
    axes.set_xlim(0, whole_s)
    return [step * step_s for step in range(steps)]


def _svg(figure: Figure, name: str, description: str) -> str:
    """Return the figure as an SVG element without header, size, or ids that two charts would share."""
    buffer = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r' id="(?![pmC][0-9a-f]{10}")[^"]*"', "", text)
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", text)
    text = re.sub(r' (width|height)="[\d.]+pt"', "", text, count=2)
    for drawn, variable in VARIABLES.items():
        text = text.replace(drawn, variable)
    return text.replace("<svg ", f'<svg role="img" aria-label="{description}" ', 1).strip()
