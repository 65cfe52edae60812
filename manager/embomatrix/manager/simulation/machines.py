"""World of a simulation: machines and scenes drawn from the scenario's seed, and the parts that all actors share."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from embomatrix.manager.simulation.invariants import InvariantChecker
from embomatrix.manager.simulation.network import EventQueue
from embomatrix.manager.simulation.report import Report
from embomatrix.rpc.wire.values import Resources

if TYPE_CHECKING:
    from embomatrix.manager.simulation.scenario import MachineKind, SimulationScenario

DURATIONS = 4096
"""Number of distinct execution times; drawing one per rollout would cost more."""

RENDER_MB = 2048
"""GPU memory for each slot that renders."""


@dataclass(frozen=True, slots=True)
class SimulatedMachine:
    """Hardware of a worker and its path to the manager. ``speed`` is the true one, ``resources`` has the claimed one."""

    worker_id: str
    resources: Resources
    speed: float
    latency_s: float
    bandwidth_mb_s: float
    lies: float = 0.0
    """Share of its executions with an invented result."""


@dataclass(frozen=True, slots=True)
class SceneSize:
    """Memory and load time of a scene on a machine of speed 1."""

    memory_mb: float
    load_s: float
    bundle_mb: float


@dataclass(frozen=True, slots=True)
class Setting:
    """A scenario with drawn machines, scenes and execution times."""

    scenario: SimulationScenario
    machines: tuple[SimulatedMachine, ...]
    scenes: dict[str, SceneSize]
    execute_s: tuple[float, ...]
    lengths: dict[str, float]
    """Factor on the execution times of each run."""

    def duration_s(self, rollout_id: str) -> float:
        """Return the execution time of a rollout on a machine of speed 1."""
        run_id = rollout_id.split(".", 1)[0]
        return self.lengths[run_id] * self.execute_s[zlib.crc32(rollout_id.encode()) % len(self.execute_s)]

    @property
    def slots(self) -> int:
        return sum(machine.resources.slots for machine in self.machines)


@dataclass(frozen=True, slots=True)
class SimulatedWorld:
    """Parts of one simulation that its manager, trainers and workers share."""

    setting: Setting
    queue: EventQueue
    checker: InvariantChecker
    report: Report


def rng_for(scenario: SimulationScenario, *key: int) -> np.random.Generator:
    """Return the random generator of one part of the scenario."""
    return np.random.default_rng(np.random.SeedSequence((scenario.seed, *key)))


def setting_of(scenario: SimulationScenario) -> Setting:
    """Draw machines, scenes and durations."""
    rng = rng_for(scenario, 1)
    sizes = scenario.scenes
    memory = sizes.memory_mb * np.exp(rng.normal(0.0, sizes.memory_spread, sizes.count))
    load = sizes.load_s * np.exp(rng.normal(0.0, sizes.load_spread, sizes.count))
    digests = [f"scene-{index:05d}" for index in range(sizes.count)]
    scenes = {
        digest: SceneSize(float(memory[at]), float(load[at]), sizes.bundle_mb)
        for at, digest in enumerate(digests)
    }
    spread = np.exp(rng.normal(0.0, scenario.execute_spread, DURATIONS))
    durations = tuple(float(value) for value in scenario.execute_s * spread)
    lengths = {trainer.name: trainer.length for trainer in scenario.trainers}
    return Setting(scenario, _machines(scenario, rng), scenes, durations, lengths)


def _machines(scenario: SimulationScenario, rng: np.random.Generator) -> tuple[SimulatedMachine, ...]:
    shares = np.array([kind.share for kind in scenario.kinds])
    # Shares are rounded to whole machines; the order is random.
    edges = np.round(np.cumsum(shares) / shares.sum() * scenario.workers).astype(int)
    kinds: list[MachineKind] = []
    for kind, edge in zip(scenario.kinds, edges, strict=True):
        kinds += [kind] * (int(edge) - len(kinds))
    order = rng.permutation(len(kinds))
    slow = rng.permutation(len(kinds)) < round(scenario.faults.slow_workers * len(kinds))
    machines = []
    for index, at in enumerate(order):
        kind = kinds[at]
        speed = kind.speed * float(rng.uniform(0.9, 1.1))
        machines.append(
            SimulatedMachine(
                worker_id=f"w{index:05d}",
                resources=Resources(
                    kind.slots,
                    kind.slots,
                    kind.memory_mb,
                    round(speed, 3),
                    versions={"platform": kind.name},
                    vram_mb=kind.render_slots * RENDER_MB,
                    render_slots=kind.render_slots,
                ),
                speed=speed / scenario.faults.slowness if slow[index] else speed,
                latency_s=kind.latency_s * float(rng.uniform(0.5, 2.0)),
                bandwidth_mb_s=kind.bandwidth_mb_s,
                lies=scenario.faults.lies if index < scenario.faults.liars else 0.0,
            )
        )
    return tuple(machines)
