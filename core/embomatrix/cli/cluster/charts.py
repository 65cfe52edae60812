"""Charts of a run's report as SVG."""

from collections.abc import Mapping, Sequence
from typing import Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator

from embomatrix.pages.charts import BAD, GOOD, SECOND, STYLE, add_legend, new_chart, svg_of
from embomatrix.rpc.wire.run_log import PhaseSummary, RolloutPhase, RunSeries

MOST_POINTS: Final = 300
"""Most points of a line at the size of a chart."""


def throughput_chart(series: RunSeries) -> str:
    """Draw completed and failed rollouts per second over the run."""
    per_step = max(1, -(-len(series.completed) // MOST_POINTS))
    step_s = series.step_s * per_step

    def rates(counts: Sequence[int]) -> list[float]:
        return [sum(counts[at : at + per_step]) / step_s for at in range(0, len(counts), per_step)]

    completed, failed = rates(series.completed), rates(series.failed)
    with mpl.rc_context(STYLE):
        figure, axes = new_chart("rollouts/s")
        times_s = _times(axes, len(completed), step_s)
        axes.fill_between(times_s, completed, step="post", color=GOOD, alpha=0.18, linewidth=0)
        axes.step(times_s, completed, where="post", color=GOOD, linewidth=1.6, label="completed")
        if any(failed):
            axes.step(times_s, failed, where="post", color=BAD, linewidth=1.6, label="failed")
            add_legend(axes)
        axes.set_ylim(bottom=0)
        return svg_of(figure, "throughput", "Completed rollouts per second over the run")


def busy_chart(shares: Sequence[float], step_s: float) -> str:
    """Draw the share of busy slots over the run."""
    with mpl.rc_context(STYLE):
        figure, axes = new_chart("slots at work")
        times_s = _times(axes, len(shares), step_s)
        axes.fill_between(times_s, list(shares), step="post", color=SECOND, alpha=0.18, linewidth=0)
        axes.step(times_s, list(shares), where="post", color=SECOND, linewidth=1.6)
        axes.set_ylim(0, 1.02)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{share:.0%}"))
        return svg_of(figure, "busy", "Share of slots at work over the run")


def phase_chart(phases: Mapping[RolloutPhase, PhaseSummary]) -> str:
    """Draw median, 95th and 99th percentile of each phase on a logarithmic axis."""
    with mpl.rc_context(STYLE):
        figure, axes = new_chart("")
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
        add_legend(axes)
        return svg_of(figure, "phases", "Quantiles of the phases of a rollout")


def _milliseconds(value_ms: float) -> str:
    return f"{value_ms / 1e3:g} s" if value_ms >= 1e3 else f"{value_ms:g} ms"


def _times(axes: Axes, steps: int, step_s: float) -> list[float]:
    """Return the start of each step in seconds, and label the axis in a fitting unit."""
    whole_s = max(steps, 1) * step_s
    unit, name = (3600.0, "h") if whole_s > 3 * 3600 else (60.0, "min") if whole_s > 180 else (1.0, "s")
    # Ticks at whole numbers of the unit, or at simple fractions of it: 0.5 min, not 1.66667 min.
    axes.xaxis.set_major_locator(
        FixedLocator([at * unit for at in MaxNLocator(8).tick_values(0, whole_s / unit)])
    )
    axes.xaxis.set_major_formatter(FuncFormatter(lambda at_s, _: f"{at_s / unit:g}"))
    axes.set_xlabel(f"{name} since the run was opened")
    axes.set_xlim(0, whole_s)
    return [step * step_s for step in range(steps)]
