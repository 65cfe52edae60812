"""Benches that other packages bring: found by entry point, imported when asked for."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Final

from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

GROUP: Final = "embomatrix.benches"


def bench_simulation(out: Path, most_workers: int, on_step: Callable[[str], None]) -> tuple[Figure, ...]:
    """Simulate clusters of up to so many workers; pictures go to ``out``.

    Raises BenchError where the manager isn't installed.
    """
    found = _brought("simulated-cluster", "manager")(out, most_workers, on_step)
    return tuple(
        Figure(item["name"], item["value"], item["unit"], Better(item["better"]), item["n"], item["goal"])
        for item in found
    )


def bench_trainer(
    dataset: Path, trl: Path | None, parts: Collection[str], on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """Measure the trainer; ``trl`` is the interpreter of an environment with TRL.

    Raises BenchError where the trainer isn't installed.
    """
    found: tuple[Figure, ...] = _brought("trainer", "all")(dataset, trl, parts, on_step)
    return found


def _brought(name: str, extra: str) -> Callable[..., Any]:
    """The bench of that name. Raises BenchError that names the extra which brings it."""
    missing = BenchError(
        f"no package offers the bench {name!r}: install it with `pip install 'embomatrix[{extra}]'`"
    )
    points = entry_points(group=GROUP, name=name)
    if not points:
        raise missing
    try:
        function: Callable[..., Any] = next(iter(points)).load()
    except ModuleNotFoundError as error:
        raise missing from error
    return function
