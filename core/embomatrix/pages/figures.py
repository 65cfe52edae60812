"""Figures of benches and evaluations: a number, how often it was measured, and how it stands to its goal."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping


class Better(StrEnum):
    """Which way a figure improves."""

    HIGHER = "higher"
    LOWER = "lower"
    NEITHER = ""


@dataclass(frozen=True, slots=True)
class Figure:
    """One number of ``n`` measurements. ``goal`` is in the same unit, None where none is set."""

    name: str
    value: float
    unit: str
    better: Better
    n: int
    goal: float | None = None

    @property
    def is_reached(self) -> bool:
        """Whether the value is at least as good as its goal; true without one."""
        if self.goal is None:
            return True
        return self.value <= self.goal if self.better is Better.LOWER else self.value >= self.goal

    @property
    def verdict(self) -> str:
        """How the value stands to its goal, in words; empty without a goal."""
        if self.goal is None:
            return ""
        if self.is_reached:
            return "reached"
        return f"{self.value / self.goal:.3g} × the goal" if self.goal else "missed"

    @property
    def bound(self) -> str:
        """The goal and the side of it on which the value should lie; empty without a goal."""
        if self.goal is None:
            return ""
        return f"{'≤' if self.better is Better.LOWER else '≥'} {shown(self.goal)}"


def shown(value: float) -> str:
    """Three digits, or all of them left of the point."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def figure_to_json(figure: Figure) -> dict[str, Any]:
    """Plain JSON values; numbers with six digits."""
    return {
        "name": figure.name,
        "value": float(f"{figure.value:.6g}"),
        "unit": figure.unit,
        "goal": figure.goal,
        "better": figure.better.value,
        "n": figure.n,
    }


def figure_from_json(item: Mapping[str, Any]) -> Figure:
    """What ``figure_to_json`` made. Raises KeyError, TypeError or ValueError where it is none."""
    goal = None if item["goal"] is None else float(item["goal"])
    return Figure(
        str(item["name"]),
        float(item["value"]),
        str(item["unit"]),
        Better(item["better"]),
        int(item["n"]),
        goal,
    )
