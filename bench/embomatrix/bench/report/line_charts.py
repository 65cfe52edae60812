"""Line charts as SVG, side by side: small, readable without a legend elsewhere, and no package to install."""

from __future__ import annotations

import html
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

WIDTH: Final = 270
HEIGHT: Final = 190
LEFT: Final = 52
RIGHT: Final = 14
TOP: Final = 26
BOTTOM: Final = 40
COLOURS: Final = ("#1f6fb2", "#d1661c", "#3a923a", "#8a5fb0", "#c23b4b")
INK: Final = "#333"
GRID: Final = "#ddd"


@dataclass(frozen=True, slots=True)
class LineChart:
    """One chart. ``lines`` hold the values of each series by x, None where nothing was measured; ``most`` tops the axis."""

    title: str
    x_label: str
    lines: Mapping[str, Mapping[float, float | None]]
    x_logarithmic: bool = False
    y_logarithmic: bool = False
    percent: bool = False
    most: float | None = None
    mark: float | None = None
    """A value to draw a line at: a goal, or a bound."""


@dataclass(frozen=True, slots=True)
class _Scale:
    """From values to pixels along one axis."""

    least: float
    most: float
    first_px: float
    last_px: float
    logarithmic: bool

    def px(self, value: float) -> float:
        if self.least == self.most:
            share = 0.5
        elif self.logarithmic:
            share = math.log(value / self.least) / math.log(self.most / self.least)
        else:
            share = (value - self.least) / (self.most - self.least)
        return self.first_px + share * (self.last_px - self.first_px)


def page(title: str, rows: Sequence[Sequence[LineChart]]) -> str:
    """The panels in rows, with one legend for all of them."""
    columns = max(len(row) for row in rows)
    width, height = columns * WIDTH, len(rows) * HEIGHT + 44
    names = list(dict.fromkeys(name for row in rows for panel in row for name in panel.lines))
    colours = {name: COLOURS[at % len(COLOURS)] for at, name in enumerate(names)}
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'font-family="Helvetica, Arial, sans-serif" fill="{INK}">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        f'<text x="{LEFT}" y="18" font-size="14" font-weight="bold">{html.escape(title)}</text>',
        *_legend(colours),
    ]
    for at, row in enumerate(rows):
        for place, panel in enumerate(row):
            parts.append(f'<g transform="translate({place * WIDTH},{44 + at * HEIGHT})">')
            parts += [*_panel(panel, colours), "</g>"]
    return "\n".join([*parts, "</svg>", ""])


def _legend(colours: Mapping[str, str]) -> list[str]:
    parts, x = [], LEFT
    for name, colour in colours.items():
        parts.append(f'<path d="M{x} 33h18" stroke="{colour}" stroke-width="2.5"/>')
        parts.append(f'<text x="{x + 23}" y="37" font-size="11">{html.escape(name)}</text>')
        x += 40 + 6 * len(name)
    return parts


def _panel(panel: LineChart, colours: Mapping[str, str]) -> list[str]:
    x, y = _scales(panel)
    parts = [f'<text x="{LEFT}" y="{TOP - 9}" font-size="12">{html.escape(panel.title)}</text>']
    for tick in _ticks(y.least, y.most, logarithmic=panel.y_logarithmic):
        at = y.px(tick)
        parts.append(f'<path d="M{LEFT} {at:.1f}H{WIDTH - RIGHT}" stroke="{GRID}"/>')
        label = f"{100 * tick:.3g} %" if panel.percent else _short(tick)
        parts.append(
            f'<text x="{LEFT - 5}" y="{at + 3.5:.1f}" font-size="10" text-anchor="end">{label}</text>'
        )
    for tick in _x_ticks(panel, x):
        parts.append(
            f'<text x="{x.px(tick):.1f}" y="{HEIGHT - BOTTOM + 14}" font-size="10" text-anchor="middle">{_short(tick)}</text>'
        )
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(
        f'<text x="{middle}" y="{HEIGHT - 10}" font-size="10.5" text-anchor="middle">{html.escape(panel.x_label)}</text>'
    )
    if panel.mark is not None and y.least <= panel.mark <= y.most:
        at = y.px(panel.mark)
        parts.append(
            f'<path d="M{LEFT} {at:.1f}H{WIDTH - RIGHT}" stroke="{INK}" stroke-dasharray="4 3" stroke-opacity=".6"/>'
        )
    for name, line in panel.lines.items():
        parts += _line(
            [(x.px(at), y.px(line[at] or 0.0)) for at in sorted(line) if line[at] is not None], colours[name]
        )
    return parts


def _line(points: Sequence[tuple[float, float]], colour: str) -> list[str]:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dots = [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="{colour}"/>' for x, y in points]
    return [f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.8"/>', *dots]


def _scales(panel: LineChart) -> tuple[_Scale, _Scale]:
    xs = [x for line in panel.lines.values() for x in line]
    ys = [y for line in panel.lines.values() for y in line.values() if y is not None]
    ys += [] if panel.mark is None else [panel.mark]
    most = max(ys) if panel.most is None else panel.most
    least = 0.0
    if panel.y_logarithmic:
        least, most = 10 ** math.floor(math.log10(min(ys))), 10 ** math.ceil(math.log10(most))
    else:
        most = most if panel.most is not None else _round_up(most)
    across = _Scale(min(xs), max(xs), LEFT + 8, WIDTH - RIGHT - 8, panel.x_logarithmic)
    return across, _Scale(least, most, HEIGHT - BOTTOM, TOP, panel.y_logarithmic)


def _ticks(least: float, most: float, *, logarithmic: bool) -> list[float]:
    if logarithmic:
        first, last = round(math.log10(least)), round(math.log10(most))
        return [10.0**power for power in range(first, last + 1)]
    return [least + (most - least) * quarter / 4 for quarter in range(5)]


def _x_ticks(panel: LineChart, x: _Scale) -> list[float]:
    """Where values are, as far as their labels don't meet."""
    ticks: list[float] = []
    for value in sorted({value for line in panel.lines.values() for value in line}):
        if not ticks or x.px(value) - x.px(ticks[-1]) >= 26:
            ticks.append(value)
    return ticks


def _round_up(value: float) -> float:
    """The next of 1, 2, 4, 5 or 10 times a power of ten."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 2, 4, 5, 10) if step * power >= value * 0.999)


def _short(value: float) -> str:
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"
