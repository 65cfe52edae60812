"""`bench simulation`: the manager's decisions in simulated clusters, one parameter varied at a time.

Every simulation checks the manager's invariants and ends the benchmark if one breaks.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

from embomatrix.manager.simulation.report import Report
from embomatrix.manager.simulation.run import simulate
from embomatrix.manager.simulation.scenario import (
    INTERNET,
    LOCAL,
    MIXED,
    Faults,
    ManagerPace,
    Scenes,
    SimulationScenario,
    Trainer,
)
from embomatrix.pages.figures import Better, Figure

GROUP: Final = 16
USUAL_WORKERS: Final = 100
"""Workers of the baseline configuration."""
WORKERS: Final = (10, 30, 100, 300, 1_000, 3_000, 10_000)
FLIGHTS: Final = {512: 32, 4_096: 256, 16_000: 1_000}
"""Rollouts in flight, and the workers of eight slots that execute them: two rollouts for each slot."""
LOOKAHEADS: Final = (0, 1, 2, 4)
NETWORKS: Final = {"own network": MIXED, "internet": INTERNET}
PACES_US: Final = (75, 150, 300)
"""CPU time of a real manager for a rollout: `bench cluster` measures it as *manager_cpu_us*, 150 µs is its goal."""
MESSAGE_S: Final = 300e-6
FULL_WORKERS: Final = (125, 250, 500, 750, 1_000, 1_500)
"""Workers with eight slots each, and four rollouts in flight for each slot."""
FULL: Final = 0.9
"""A manager is saturated if less than this share of the slots is busy although there is work for all."""
MOST_CPU_US: Final = 150.0


def in_flight(workers: int, rollouts: int) -> SimulationScenario:
    """Submit this number of rollouts at once to servers with 8 slots."""
    trainer = Trainer(
        steps=2, groups=rollouts // GROUP, group_size=GROUP, write_s=0.0, update_s=1.0, start_s=10.0
    )
    return SimulationScenario(
        workers=workers,
        kinds=(LOCAL,),
        scenes=Scenes(count=max(200, 2 * trainer.groups)),
        execute_s=1.0,
        execute_spread=0.3,
        trainers=(trainer,),
        join_s=8.0,
    )


def loaded_slowly(lookahead: int) -> SimulationScenario:
    """Scenes that load in two seconds, each used once on 16 slots: without look-ahead every scene is cold."""
    trainer = Trainer(steps=60, groups=4, group_size=16, lookahead=lookahead, write_s=1.0, update_s=1.0)
    return SimulationScenario(
        workers=4,
        kinds=(replace(LOCAL, slots=4, memory_mb=1024),),
        scenes=Scenes(count=trainer.steps * trainer.groups, load_s=2.0, load_spread=0.1),
        execute_s=0.05,
        trainers=(trainer,),
    )


def sweeps(most_workers: int) -> dict[str, dict[float, SimulationScenario]]:
    """Scenarios by parameter and value: workers up to ``most_workers``, look-ahead, load time, deaths an hour."""
    usual = _cluster(min(USUAL_WORKERS, most_workers))
    (trainer,) = usual.trainers
    return {
        "workers": {count: _cluster(count) for count in WORKERS if count <= most_workers},
        "steps announced ahead": {
            ahead: replace(usual, trainers=(replace(trainer, lookahead=ahead),)) for ahead in range(5)
        },
        "s to load a scene": {
            load_s: replace(usual, scenes=replace(usual.scenes, load_s=load_s))
            for load_s in (0.1, 0.5, 2.0, 8.0, 30.0)
        },
        "deaths of each worker in an hour": {
            rate: replace(usual, faults=Faults(death_rate=rate / 3600, silent_deaths=0.5, respawn_s=20.0))
            for rate in (0, 6, 20, 60)
        },
    }


def _cluster(workers: int) -> SimulationScenario:
    """Baseline configuration: trainers generate and update between steps of more than one rollout for each slot."""
    # The largest clusters take fewer and smaller steps; the cost of a rollout is the same.
    steps, each = (6, 15) if workers <= 300 else (2, 15) if workers <= 3_000 else (2, 9)
    groups = max(2, workers * each // GROUP)
    trainer = Trainer(
        steps=steps, groups=groups, group_size=GROUP, lookahead=2, write_s=2.0, update_s=2.0, start_s=12.0
    )
    return SimulationScenario(
        workers=workers,
        scenes=Scenes(count=max(600, groups), load_s=2.0),
        execute_s=1.0,
        execute_spread=0.3,
        trainers=(trainer,),
        join_s=10.0,
    )


@dataclass(slots=True)
class SimulationBench:
    """Runs simulations and counts their rollouts."""

    on_step: Callable[[str], None]
    run: Callable[[SimulationScenario], Report] = simulate
    rollouts: int = 0
    failures: int = 0
    simulations: int = 0

    def simulate(self, step: str, scenario: SimulationScenario) -> Report:
        self.on_step(step)
        report = self.run(scenario)
        self.rollouts += report.delivered
        self.failures += report.infra_failures
        self.simulations += 1
        return report

    def figures(self, most_workers: int) -> Iterator[Figure]:
        """Yield all figures. Raise BrokenInvariantError if the manager breaks a promise."""
        yield from self._sweep_figures(most_workers)
        yield from self._flight_figures(most_workers)
        yield from self._lookahead_figures()
        yield from self.saturation_figures(most_workers)
        count = self.simulations
        yield Figure("sim_simulations", count, "count", Better.HIGHER, count)
        yield Figure("sim_rollouts", self.rollouts, "count", Better.HIGHER, count)
        yield Figure("sim_infra_failures", self.failures, "count", Better.LOWER, self.rollouts)
        # A broken invariant would have raised.
        yield Figure("sim_broken_invariants", 0, "count", Better.LOWER, count, 0)

    def _sweep_figures(self, most_workers: int) -> Iterator[Figure]:
        for parameter, scenarios in sweeps(most_workers).items():
            for network, kinds in NETWORKS.items():
                for value, scenario in scenarios.items():
                    where = f"{value:,g} {parameter}, {network}"
                    report = self.simulate(where, replace(scenario, kinds=kinds))
                    count = report.delivered
                    yield Figure(f"sim_cpu_us, {where}", report.cpu_us_per_rollout, "µs", Better.LOWER, count)
                    yield from _busy_slots(where, report)
                    yield Figure(f"sim_stall, {where}", report.stall, "share", Better.LOWER, count)
                    yield _hits(where, report)
                    yield _waste(where, report)

    def _flight_figures(self, most_workers: int) -> Iterator[Figure]:
        for rollouts, workers in FLIGHTS.items():
            if workers <= max(most_workers, min(FLIGHTS.values())):
                where = f"{rollouts:,} in flight"
                report = self.simulate(where, in_flight(workers, rollouts))
                cost_us, count = report.cpu_us_per_rollout, report.delivered
                yield Figure(f"sim_cpu_us, {where}", cost_us, "µs", Better.LOWER, count, MOST_CPU_US)
                yield Figure(f"sim_first_result_s, {where}", report.first_result_s, "s", Better.LOWER, 1)
                yield from _busy_slots(where, report, 0.8)

    def _lookahead_figures(self) -> Iterator[Figure]:
        cold_s = 0.0
        for ahead in LOOKAHEADS:
            report = self.simulate(f"slow loading, k={ahead}", loaded_slowly(ahead))
            goals: Mapping[str, float] = {"hits": 0.95, "waste": 0.1, "start": 0.05} if ahead >= 2 else {}
            yield _hits(f"k={ahead}", report, goals.get("hits"))
            yield _waste(f"k={ahead}", report, goals.get("waste"))
            cold_s = cold_s or report.start_latency_s
            ratio, name = report.start_latency_s / cold_s, f"sim_start_latency_ratio, k={ahead}"
            if ahead:
                yield Figure(name, ratio, "share", Better.LOWER, report.foretold, goals.get("start"))

    def saturation_figures(self, most_workers: int) -> Iterator[Figure]:
        """Yield busy slots and lag of managers that take time for each rollout, up to clearly saturated ones."""
        counts = [count for count in FULL_WORKERS if count <= most_workers] or [most_workers]
        for pace_us in PACES_US:
            for count in counts:
                slots = 8 * count
                where = f"{pace_us} µs a rollout, {slots:,} slots"
                pace = ManagerPace(pace_us * 1e-6, MESSAGE_S)
                report = self.simulate(where, replace(in_flight(count, 4 * slots), manager=pace))
                yield from _busy_slots(where, report)
                lag_s, rollouts = report.lag_p99_s, report.delivered
                yield Figure(f"sim_manager_lag_p99_s, {where}", lag_s, "s", Better.LOWER, rollouts)
                if (report.pressed_utilisation or 0.0) < FULL / 2:
                    break


def _busy_slots(where: str, report: Report, goal: float | None = None) -> Iterator[Figure]:
    """Share of busy slots while there was work for all of them; nothing if that never was."""
    share = report.pressed_utilisation
    if share is not None:
        yield Figure(f"sim_slots_at_work, {where}", share, "share", Better.HIGHER, report.delivered, goal)


def _hits(where: str, report: Report, goal: float | None = None) -> Figure:
    return Figure(f"sim_hit_rate, {where}", report.hit_rate, "share", Better.HIGHER, report.foretold, goal)


def _waste(where: str, report: Report, goal: float | None = None) -> Figure:
    return Figure(f"sim_waste, {where}", report.waste, "share", Better.LOWER, report.loads, goal)
