"""What `embomatrix bench cluster --simulate` does: simulate the sweeps, draw them, and hand in figures.

The command finds this by entry point: the worker's package, where the other benches are, imports nothing of the manager.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from embomatrix.bench.cluster.saturation import saturated, saturation_figures, saturation_panels
from embomatrix.bench.cluster.simulated_sweeps import in_flight, loaded_slowly, sweeps
from embomatrix.bench.report.line_charts import LineChart, page
from embomatrix.manager.simulation.run import Report, simulate

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from embomatrix.bench.cluster.simulated_sweeps import Sweep
    from embomatrix.manager.simulation.scenario import SimulationScenario

FLIGHTS: Final = {512: 32, 4_096: 256, 16_000: 1_000}
"""Rollouts in flight, and the workers of eight slots that execute them: two rollouts for each slot."""
LOOKAHEADS: Final = (0, 1, 2, 4)
MOST_CPU_US: Final = 150.0


@dataclass(frozen=True, slots=True)
class Measure:
    """One row of charts: what is read off a report."""

    title: str
    value: Callable[[Report], float | None]
    mark: float | None = None


MEASURES: Final = (
    Measure("slots at work while there is work", lambda report: report.pressed_utilisation),
    Measure("trainer stands still", lambda report: report.stall),
    Measure("scenes warm when asked for", lambda report: report.hit_rate, mark=0.95),
    Measure("loads that nobody used", lambda report: report.waste, mark=0.1),
)


@dataclass(slots=True)
class _Bench:
    """Simulates and keeps count: every simulation asserts the invariants, and ends the bench when one breaks."""

    on_step: Callable[[str], None]
    rollouts: int = 0
    failures: int = 0
    simulations: int = 0

    def run(self, what: str, scenario: SimulationScenario) -> Report:
        self.on_step(what)
        report = simulate(scenario)
        self.rollouts += report.delivered
        self.failures += report.infra_failures
        self.simulations += 1
        return report


def bench_simulated_cluster(
    out: Path, most_workers: int, on_step: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Writes ``simulated_cluster.svg``, ``simulated_manager.svg`` and ``simulated_saturation.svg`` into the folder.

    Returns figures as `bench` writes them.

    Raises BrokenInvariantError when the manager breaks a promise, with what happened.
    """
    bench = _Bench(on_step)
    swept = [(sweep, _simulated(bench, sweep)) for sweep in sweeps(most_workers)]
    flights = {
        count: bench.run(f"{count:,} rollouts in flight", in_flight(workers, count))
        for count, workers in FLIGHTS.items()
        if workers <= max(most_workers, min(FLIGHTS.values()))
    }
    ahead = {k: bench.run(f"A13 with k = {k}", loaded_slowly(k)) for k in LOOKAHEADS}
    full = saturated(bench.run, most_workers)
    out.mkdir(parents=True, exist_ok=True)
    (out / "simulated_cluster.svg").write_text(_cluster_page(swept), encoding="utf-8")
    workers = swept[0][1]
    (out / "simulated_manager.svg").write_text(_manager_page(workers, flights), encoding="utf-8")
    panels = saturation_panels(full)
    (out / "simulated_saturation.svg").write_text(
        page("Where one manager is full", [panels]), encoding="utf-8"
    )
    return [
        *_flight_figures(flights),
        *_worker_figures(workers["own network"]),
        *_saturation_figures(workers["own network"]),
        *saturation_figures(full),
        *_lookahead_figures(ahead),
        _figure("sim_simulations", bench.simulations, "count", "higher", bench.simulations),
        _figure("sim_rollouts", bench.rollouts, "count", "higher", bench.simulations),
        _figure("sim_infra_failures", bench.failures, "count", "lower", bench.rollouts),
        # A simulation in which one broke has ended the bench before it came here.
        _figure("sim_broken_invariants", 0, "count", "lower", bench.simulations, 0),
    ]


def _simulated(bench: _Bench, sweep: Sweep) -> dict[str, dict[float, Report]]:
    return {
        network: {
            value: bench.run(f"{sweep.axis} = {value:g}, {network}", scenario)
            for value, scenario in points.items()
        }
        for network, points in sweep.points.items()
    }


def _cluster_page(swept: list[tuple[Sweep, dict[str, dict[float, Report]]]]) -> str:
    rows = [
        [
            LineChart(
                measure.title,
                sweep.axis,
                {
                    network: {value: measure.value(report) for value, report in reports.items()}
                    for network, reports in found.items()
                },
                x_logarithmic=sweep.logarithmic,
                percent=True,
                most=1.0,
                mark=measure.mark,
            )
            for sweep, found in swept
        ]
        for measure in MEASURES
    ]
    return page("The manager's decisions in a simulated cluster", rows)


def _manager_page(workers: Mapping[str, Mapping[float, Report]], flights: Mapping[int, Report]) -> str:
    local = workers["own network"]
    kinds = _dearest_kinds(local)
    row = [
        LineChart(
            "CPU of all decisions, µs a rollout",
            "workers",
            {name: {x: r.cpu_us_per_rollout for x, r in found.items()} for name, found in workers.items()},
            x_logarithmic=True,
            mark=MOST_CPU_US,
        ),
        LineChart(
            "CPU of a message, µs",
            "workers",
            {kind: {x: 1e6 * r.costs[kind].mean_s for x, r in local.items()} for kind in kinds},
            x_logarithmic=True,
            y_logarithmic=True,
        ),
        LineChart(
            "one core at work on decisions",
            "workers",
            {name: {x: r.manager_load for x, r in found.items()} for name, found in workers.items()},
            x_logarithmic=True,
            percent=True,
        ),
        LineChart(
            "CPU of all decisions, µs a rollout",
            "rollouts in flight",
            {"own network": {count: report.cpu_us_per_rollout for count, report in flights.items()}},
            x_logarithmic=True,
            mark=MOST_CPU_US,
        ),
    ]
    return page("What the manager's decisions cost", [row])


def _dearest_kinds(reports: Mapping[float, Report]) -> list[str]:
    """The kinds of messages on which the manager spends most in the largest cluster."""
    costs = reports[max(reports)].costs
    return [kind for kind, _ in Counter({kind: cost.total_s for kind, cost in costs.items()}).most_common(3)]


def _flight_figures(flights: Mapping[int, Report]) -> list[dict[str, Any]]:
    figures = []
    for count, report in flights.items():
        what, rollouts = f"{count:,} in flight", report.delivered
        figures += [
            _figure(f"sim_cpu_us, {what}", report.cpu_us_per_rollout, "µs", "lower", rollouts, MOST_CPU_US),
            _figure(f"sim_first_result_s, {what}", report.first_result_s, "s", "lower", 1),
            *_at_work(what, report, 0.8),
        ]
    return figures


def _worker_figures(reports: Mapping[float, Report]) -> list[dict[str, Any]]:
    figures = []
    for count, report in reports.items():
        workers, rollouts = f"{int(count):,} workers", report.delivered
        figures += [
            _figure(f"sim_cpu_us, {workers}", report.cpu_us_per_rollout, "µs", "lower", rollouts),
            *_at_work(workers, report),
            _figure(f"sim_stall, {workers}", report.stall, "share", "lower", rollouts),
        ]
    return figures


def _saturation_figures(reports: Mapping[float, Report]) -> list[dict[str, Any]]:
    """What one core can decide: what is left of it beside what the workers' mere presence costs, over a rollout's cost."""
    most = int(max(reports))
    report = reports[most]
    costs = report.costs
    per_rollout_s = (
        sum(costs[kind].total_s for kind in ("batch", "result", "look-ahead") if kind in costs)
        / report.delivered
    )
    present_s = sum(costs[kind].total_s for kind in ("heartbeat", "tick") if kind in costs)
    share = present_s / (report.elapsed_s + report.scenario.trainers[0].start_s)
    return [
        _figure(f"sim_presence, {most:,} workers", share, "share", "lower", most, None),
        _figure(
            f"sim_saturation_rollouts_per_s, {most:,} workers",
            (1.0 - share) / per_rollout_s,
            "1/s",
            "higher",
            report.delivered,
            None,
        ),
    ]


def _lookahead_figures(ahead: Mapping[int, Report]) -> list[dict[str, Any]]:
    cold_s = ahead[0].start_latency_s
    figures = []
    for k, report in ahead.items():
        batches = report.foretold
        goal = 0.95 if k >= 2 else None
        figures.append(_figure(f"sim_hit_rate, k={k}", report.hit_rate, "share", "higher", batches, goal))
        figures.append(
            _figure(
                f"sim_waste, k={k}", report.waste, "share", "lower", report.loads, 0.1 if k >= 2 else None
            )
        )
        if k:
            ratio = report.start_latency_s / cold_s
            figures.append(
                _figure(
                    f"sim_start_latency_ratio, k={k}",
                    ratio,
                    "share",
                    "lower",
                    batches,
                    0.05 if k >= 2 else None,
                )
            )
    return figures


def _at_work(what: str, report: Report, goal: float | None = None) -> list[dict[str, Any]]:
    """Nothing where there was never work for all slots at once."""
    share = report.pressed_utilisation
    if share is None:
        return []
    return [_figure(f"sim_slots_at_work, {what}", share, "share", "higher", report.delivered, goal)]


def _figure(
    name: str, value: float, unit: str, better: str, n: int, goal: float | None = None
) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "goal": goal, "better": better, "n": n}
