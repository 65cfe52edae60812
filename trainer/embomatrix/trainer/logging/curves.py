"""Curves of a training run as SVG: held-out success with its interval, and figures of each step."""

from collections.abc import Sequence
from typing import Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MaxNLocator

from embomatrix.pages.charts import GOOD, SECOND, STYLE, new_chart, svg_of
from embomatrix.pages.figures import Interval

WINDOW_SHARE: Final = 0.05
"""Width of the moving average, as a share of the steps."""


def success_curve(points: Sequence[tuple[int, Interval]]) -> str:
    """Draw held-out success after numbers of steps, with 95 % intervals as a band."""
    steps = [step for step, _ in points]
    with mpl.rc_context(STYLE):
        figure, axes = new_chart("held-out success")
        low, high = ([getattr(found, side) for _, found in points] for side in ("low", "high"))
        axes.fill_between(steps, low, high, color=GOOD, alpha=0.18, linewidth=0)
        axes.plot(
            steps,
            [found.value for _, found in points],
            "o-",
            color=GOOD,
            linewidth=1.8,
            markersize=4,
            clip_on=False,
        )
        axes.set_ylim(bottom=0)
        _as_shares(axes)
        _steps(axes, max(steps))
        return svg_of(figure, "held-out", "Held-out success during training, with 95 % intervals")


def step_curve(name: str, label: str, series: Sequence[float | None], *, share: bool = False) -> str:
    """Draw the figure of each step (thin) and its moving average (bold). Empty if no step has a value.

    ``share``: the figure is a share, on an axis from 0 to 100 %.
    """
    known = [(step, value) for step, value in enumerate(series, start=1) if value is not None]
    if not known:
        return ""
    steps, values = [step for step, _ in known], [value for _, value in known]
    window = max(1, round(len(values) * WINDOW_SHARE))
    means = [sum(values[max(0, at + 1 - window) : at + 1]) / min(at + 1, window) for at in range(len(values))]
    with mpl.rc_context(STYLE):
        figure, axes = new_chart(label)
        axes.plot(steps, values, color=SECOND, linewidth=0.8, alpha=0.35)
        axes.plot(steps, means, color=SECOND, linewidth=1.8)
        if share:
            axes.set_ylim(0, 1.02)
            _as_shares(axes)
        _steps(axes, len(series))
        return svg_of(figure, name, f"{label} by step")


def _as_shares(axes: Axes) -> None:
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0%}"))


def _steps(axes: Axes, last: int) -> None:
    axes.set_xlabel("step of GRPO")
    axes.set_xlim(0, max(last, 1))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
