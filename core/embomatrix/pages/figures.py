"""Figures of benchmarks and evaluations: a value, its number of measurements, and its goal."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

_DIGITS: Final = 3
_MOST_DIGITS: Final = 6
_Z: Final = 1.959963984540054
"""Quantile of the standard normal distribution at 0.975: intervals are of 95 %."""


class Better(StrEnum):
    """Direction in which a figure improves."""

    HIGHER = "higher"
    LOWER = "lower"
    NEITHER = ""


@dataclass(frozen=True, slots=True)
class Figure:
    """A value from ``n`` measurements. ``goal`` has the same unit; None if there is no goal."""

    name: str
    value: float
    unit: str
    better: Better
    n: int
    goal: float | None = None

    @property
    def is_reached(self) -> bool:
        """True if the value is at least as good as its goal, or there is no goal."""
        if self.goal is None:
            return True
        return self.value <= self.goal if self.better is Better.LOWER else self.value >= self.goal

    @property
    def verdict(self) -> str:
        """Relation of the value to its goal, in words; empty without a goal."""
        if self.goal is None:
            return ""
        if self.is_reached:
            return "reached"
        return f"{shown(self.value / self.goal, other_than=1.0)} × the goal" if self.goal else "missed"

    @property
    def formatted(self) -> str:
        """The formatted value. A narrowly missed goal is not rounded up to."""
        return shown(self.value, other_than=None if self.is_reached else self.goal)

    @property
    def bound(self) -> str:
        """The goal with ≤ or ≥; empty without a goal."""
        if self.goal is None:
            return ""
        return f"{'≤' if self.better is Better.LOWER else '≥'} {shown(self.goal)}"


def shown(value: float, *, other_than: float | None = None) -> str:
    """Format a value with three digits, or more if it would otherwise read like ``other_than``."""
    for digits in range(_DIGITS, _MOST_DIGITS):
        text = _rounded(value, digits)
        if other_than is None or text != _rounded(other_than, digits):
            return text
    return _rounded(value, _MOST_DIGITS)


def _rounded(value: float, digits: int) -> str:
    whole = len(f"{abs(value):.0f}")
    return f"{value:,.{max(0, digits - whole)}f}" if whole > _DIGITS else f"{value:.{digits}g}"


def figure_to_json(figure: Figure) -> dict[str, Any]:
    """Return a JSON-serialisable dict, numbers with six digits."""
    return {
        "name": figure.name,
        "value": float(f"{figure.value:.6g}"),
        "unit": figure.unit,
        "goal": figure.goal,
        "better": figure.better.value,
        "n": figure.n,
    }


def figure_from_json(item: Mapping[str, Any]) -> Figure:
    """Read a dict made by ``figure_to_json``. Raise KeyError, TypeError or ValueError if it is malformed."""
    goal = None if item["goal"] is None else float(item["goal"])
    return Figure(
        str(item["name"]),
        float(item["value"]),
        str(item["unit"]),
        Better(item["better"]),
        int(item["n"]),
        goal,
    )


@dataclass(frozen=True, slots=True)
class Interval:
    """Estimate with its 95 % interval."""

    value: float
    low: float
    high: float

    def as_percent(self) -> str:
        return f"{self.value:z.1%} [{self.low:z.1%}, {self.high:z.1%}]"  # z: no -0.0%


def wilson(share: float, count: int) -> Interval:
    """Wilson score interval (1927) of a share of ``count`` >= 1 independent trials."""
    middle = share + _Z**2 / (2 * count)
    spread = _Z * math.sqrt(share * (1 - share) / count + _Z**2 / (4 * count**2))
    scale = 1 + _Z**2 / count
    return Interval(share, max(0.0, (middle - spread) / scale), min(1.0, (middle + spread) / scale))
