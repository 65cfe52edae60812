"""The machines and scenes of a scenario, drawn from its seed."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from embomatrix.rpc.wire.values import Resources

if TYPE_CHECKING:
    from embomatrix.manager.simulation.scenario import MachineKind, SimulationScenario

DURATIONS = 4096
"""Distinct execution times: rollouts take them in turn, which costs less than drawing one for each."""

RENDER_MB = 2048
"""Memory of the GPU for each slot that renders."""


@dataclass(frozen=True, slots=True)
class SimulatedMachine:
    """A worker's hardware and its way to the manager. ``speed`` is the true one; ``resources`` say what it claims."""

    worker_id: str
    kind: str
    resources: Resources
    speed: float
    latency_s: float
    bandwidth_mb_s: float
    lies: float = 0.0
    """Share of its executions whose result it makes up."""


@dataclass(frozen=True, slots=True)
class SceneSize:
    """What a scene costs on a machine of speed 1."""

    digest: str
    memory_mb: float
    load_s: float
    bundle_mb: float


@dataclass(frozen=True, slots=True)
class Setting:
    """A scenario with its dice thrown. ``execute_s`` are the durations that rollouts take in turn."""

    machines: tuple[SimulatedMachine, ...]
    scenes: dict[str, SceneSize]
    execute_s: tuple[float, ...]
    lengths: dict[str, float]
    """How many times longer the rollouts of each run take."""

    def duration_s(self, rollout_id: str) -> float:
        """Of this rollout's execution on a machine of speed 1: the same wherever it is executed."""
        run_id = rollout_id.split(".", 1)[0]
        return self.lengths[run_id] * self.execute_s[zlib.crc32(rollout_id.encode()) % len(self.execute_s)]

    @property
    def slots(self) -> int:
        return sum(machine.resources.slots for machine in self.machines)


def rng_for(scenario: SimulationScenario, *key: int) -> np.random.Generator:
    """The generator of one part of the scenario: parts do not disturb one another."""
    return np.random.default_rng(np.random.SeedSequence((scenario.seed, *key)))


def setting_of(scenario: SimulationScenario) -> Setting:
    """Draw machines, scenes and durations."""
    rng = rng_for(scenario, 1)
    sizes = scenario.scenes
    memory = sizes.memory_mb * np.exp(rng.normal(0.0, sizes.memory_spread, sizes.count))
    load = sizes.load_s * np.exp(rng.normal(0.0, sizes.load_spread, sizes.count))
    digests = [f"scene-{index:05d}" for index in range(sizes.count)]
    scenes = {
        digest: SceneSize(digest, float(memory[at]), float(load[at]), sizes.bundle_mb)
        for at, digest in enumerate(digests)
    }
    spread = np.exp(rng.normal(0.0, scenario.execute_spread, DURATIONS))
    durations = tuple(float(value) for value in scenario.execute_s * spread)
    lengths = {trainer.name: trainer.length for trainer in scenario.trainers}
    return Setting(_machines(scenario, rng), scenes, durations, lengths)


def _machines(scenario: SimulationScenario, rng: np.random.Generator) -> tuple[SimulatedMachine, ...]:
    shares = np.array([kind.share for kind in scenario.kinds])
    # The shares hold as exactly as whole machines allow, in an order that the seed gives.
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
                kind=kind.name,
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
