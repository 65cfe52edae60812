"""The simulated cluster among the benches: brought by the manager's package, found by entry point, imported when asked for."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Final

from embomatrix.pages.figures import Better, Figure
from embomatrix.worker.bench_figures import BenchError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

GROUP: Final = "embomatrix.benches"
NAME: Final = "simulated-cluster"


def bench_simulation(out: Path, most_workers: int, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Simulate clusters of up to so many workers; pictures go to ``out``.

    Raises BenchError where the manager isn't installed.
    """
    points = entry_points(group=GROUP, name=NAME)
    if not points:
        raise BenchError(
            f"no package offers the bench {NAME!r}: install it with `pip install 'embomatrix[manager]'`"
        )
    found = next(iter(points)).load()(out, most_workers, on_step)
    return tuple(
        Figure(item["name"], item["value"], item["unit"], Better(item["better"]), item["n"], item["goal"])
        for item in found
    )
