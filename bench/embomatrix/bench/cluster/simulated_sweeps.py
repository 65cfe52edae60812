"""Which clusters the bench simulates: one thing varied at a time, near by and over the internet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from embomatrix.manager.simulation.scenario import (
    INTERNET,
    LOCAL,
    MIXED,
    Faults,
    Scenes,
    SimulationScenario,
    Trainer,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

NETWORKS: Final = {"own network": MIXED, "internet": INTERNET}
GROUP: Final = 16
USUAL_WORKERS: Final = 100
"""Where something else than their number varies."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """``points`` are by network and by the value of what varies; ``scale`` says how they stand on the axis."""

    name: str
    axis: str
    logarithmic: bool
    points: Mapping[str, Mapping[float, SimulationScenario]]


def sweeps(most_workers: int) -> list[Sweep]:
    """What varies: workers up to ``most_workers``, look-ahead, load time, deaths."""
    usual = _cluster(min(USUAL_WORKERS, most_workers))
    return [
        _sweep("workers", "workers", _by_workers(most_workers), logarithmic=True),
        _sweep("lookahead", "steps announced ahead, k", _by_lookahead(usual), logarithmic=False),
        _sweep("load", "load time of a scene, s", _by_load_time(usual), logarithmic=True),
        _sweep("deaths", "deaths of each worker in an hour", _by_deaths(usual), logarithmic=False),
    ]


def in_flight(workers: int, rollouts: int) -> SimulationScenario:
    """So many rollouts at once on so many servers with 8 slots: what the manager's CPU is measured with."""
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
    """Scenes that take two seconds to load, each used once on 16 slots: without look-ahead every one is cold."""
    trainer = Trainer(steps=60, groups=4, group_size=16, lookahead=lookahead, write_s=1.0, update_s=1.0)
    return SimulationScenario(
        workers=4,
        kinds=(replace(LOCAL, slots=4, memory_mb=1024),),
        scenes=Scenes(count=trainer.steps * trainer.groups, load_s=2.0, load_spread=0.1),
        execute_s=0.05,
        trainers=(trainer,),
    )


def _sweep(
    name: str, axis: str, scenarios: Mapping[float, SimulationScenario], *, logarithmic: bool
) -> Sweep:
    points = {
        network: {value: replace(scenario, kinds=kinds) for value, scenario in scenarios.items()}
        for network, kinds in NETWORKS.items()
    }
    return Sweep(name, axis, logarithmic, points)


def _cluster(workers: int) -> SimulationScenario:
    """Trainers write and update between steps, and in each there is more than a rollout for each slot."""
    # The largest clusters take fewer and smaller steps: what a step costs is the same in each.
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


def _by_workers(most: int) -> dict[float, SimulationScenario]:
    return {count: _cluster(count) for count in (10, 30, 100, 300, 1_000, 3_000, 10_000) if count <= most}


def _by_lookahead(usual: SimulationScenario) -> dict[float, SimulationScenario]:
    (trainer,) = usual.trainers
    return {k: replace(usual, trainers=(replace(trainer, lookahead=k),)) for k in range(5)}


def _by_load_time(usual: SimulationScenario) -> dict[float, SimulationScenario]:
    times_s = (0.1, 0.5, 2.0, 8.0, 30.0)
    return {time_s: replace(usual, scenes=replace(usual.scenes, load_s=time_s)) for time_s in times_s}


def _by_deaths(usual: SimulationScenario) -> dict[float, SimulationScenario]:
    return {
        rate: replace(usual, faults=Faults(death_rate=rate / 3600, silent_deaths=0.5, respawn_s=20.0))
        for rate in (0, 6, 20, 60)
    }
