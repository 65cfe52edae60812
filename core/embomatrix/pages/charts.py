"""Charts of reports as SVG. The page sets their colours, for light and dark themes."""

import io
import re
from collections.abc import Mapping
from typing import Any, Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

SIZE_IN: Final = (6.2, 2.5)
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
"""Settings of matplotlib for ``rc_context`` while a chart is drawn."""


def new_chart(label: str) -> tuple[Figure, Axes]:
    """Return an empty chart with this label of its vertical axis. Use it within ``rc_context(STYLE)``."""
    figure = Figure(figsize=SIZE_IN, layout="constrained")
    axes = figure.add_subplot()
    axes.set_ylabel(label)
    axes.grid(visible=True, axis="y", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(length=0)
    return figure, axes


def add_legend(axes: Axes) -> None:
    """Put the legend above the chart."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, borderaxespad=0.1)


def svg_of(figure: Figure, name: str, description: str) -> str:
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
