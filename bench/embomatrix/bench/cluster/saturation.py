"""Where one manager is full: more and more slots ask a manager that takes time with each rollout, until slots stand still."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from embomatrix.bench.cluster.simulated_sweeps import in_flight
from embomatrix.bench.report.line_charts import LineChart
from embomatrix.manager.simulation.scenario import ManagerPace

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from embomatrix.manager.simulation.run import Report
    from embomatrix.manager.simulation.scenario import SimulationScenario

PACES: Final = {
    "75 µs a rollout": ManagerPace(75e-6, 300e-6),
    "150 µs a rollout": ManagerPace(150e-6, 300e-6),
    "300 µs a rollout": ManagerPace(300e-6, 300e-6),
}
"""`embomatrix bench cluster` measures them as *manager_cpu_us*, with gRPC and the store; 150 is its goal."""
WORKERS: Final = (125, 250, 500, 750, 1_000, 1_500)
"""With eight slots each."""
EACH: Final = 4
"""Rollouts in flight for each slot."""
FULL: Final = 0.9
"""A manager is full when less than this share of the slots is at work while there is work for all."""


def saturation(pace: ManagerPace, most_workers: int) -> dict[float, SimulationScenario]:
    """By slots: servers that execute rollouts of a second under such a manager."""
    counts = [count for count in WORKERS if count <= most_workers] or [most_workers]
    return {8 * count: replace(in_flight(count, 8 * count * EACH), manager=pace) for count in counts}


def saturated(
    run: Callable[[str, SimulationScenario], Report], most_workers: int
) -> dict[str, dict[float, Report]]:
    """Simulate the sweep of each pace. Past the first cluster for which a manager is too slow there is nothing to learn."""
    found: dict[str, dict[float, Report]] = {}
    for name, pace in PACES.items():
        reports = found.setdefault(name, {})
        for slots, scenario in saturation(pace, most_workers).items():
            reports[slots] = run(f"{slots:,.0f} slots, {name}", scenario)
            if at_work(reports[slots]) < FULL / 2:
                break
    return found


def at_work(report: Report) -> float:
    """Share of the slots that execute something, while there is work for all."""
    return report.pressed_utilisation or 0.0


def saturation_panels(found: Mapping[str, Mapping[float, Report]]) -> list[LineChart]:
    """Slots at work, and how far the manager lags behind, against slots."""
    return [
        LineChart(
            "slots at work, rollouts of 1 s",
            "slots",
            {
                name: {slots: at_work(report) for slots, report in reports.items()}
                for name, reports in found.items()
            },
            x_logarithmic=True,
            percent=True,
            most=1.0,
            mark=FULL,
        ),
        LineChart(
            "messages wait, p99, s",
            "slots",
            {
                name: {slots: report.lag_p99_s for slots, report in reports.items()}
                for name, reports in found.items()
            },
            x_logarithmic=True,
        ),
    ]


def saturation_figures(found: Mapping[str, Mapping[float, Report]]) -> list[dict[str, Any]]:
    """Of each pace: the most slots that were kept at work, with the lag there, and where they no longer were."""
    figures: list[dict[str, Any]] = []
    for name, reports in found.items():
        kept = [slots for slots, report in reports.items() if at_work(report) >= FULL]
        if kept:
            figures += _point(f"{name}, {max(kept):,.0f} slots", reports[max(kept)])
        lost = [slots for slots in reports if slots not in kept]
        if lost:
            figures += _point(f"{name}, {min(lost):,.0f} slots", reports[min(lost)])
    return figures


def _point(where: str, report: Report) -> list[dict[str, Any]]:
    shared = {"goal": None, "n": report.delivered}
    return [
        {
            "name": f"sim_slots_at_work, {where}",
            "value": at_work(report),
            "unit": "share",
            "better": "higher",
            **shared,
        },
        {
            "name": f"sim_manager_lag_p99_s, {where}",
            "value": report.lag_p99_s,
            "unit": "s",
            "better": "lower",
            **shared,
        },
    ]
