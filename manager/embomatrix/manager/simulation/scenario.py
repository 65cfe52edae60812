"""What is simulated: machines, scenes, trainers and faults, as values. Times are seconds, sizes megabytes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from embomatrix.manager.control.dispatch.state import DispatchLimits
from embomatrix.manager.control.schedule.scheduler import ScheduleLimits
from embomatrix.manager.runtime.registry import LivenessLimits
from embomatrix.rpc.wire.values import RunTerms


@dataclass(frozen=True, slots=True)
class MachineKind:
    """A kind of worker. ``share`` of all workers are such; ``speed`` divides load and execution times."""

    name: str
    share: float
    slots: int
    memory_mb: int
    speed: float
    latency_s: float
    """One way between it and the manager."""
    bandwidth_mb_s: float
    """For bundles."""
    render_slots: int = 0
    """Slots of them that render."""


LOCAL = MachineKind("server", 1.0, 8, 2048, 1.0, 0.0002, 100.0)
"""A server in the manager's own network."""
MIXED = (
    MachineKind("server", 0.2, 16, 4096, 1.0, 0.0005, 100.0),
    MachineKind("workstation", 0.4, 8, 2048, 1.2, 0.001, 50.0),
    MachineKind("cloud VM", 0.2, 4, 1024, 0.8, 0.02, 25.0),
    MachineKind("spare PC", 0.2, 2, 512, 0.6, 0.06, 4.0),
)
"""Servers, workstations, machines of a cloud and idle PCs at people's homes."""
INTERNET = tuple(replace(kind, latency_s=0.08, bandwidth_mb_s=4.0) for kind in MIXED)
"""The same machines, all of them far away."""


@dataclass(frozen=True, slots=True)
class Scenes:
    """The scenes there are. Sizes and times are log-normal: a median, and the spread of the logarithm."""

    count: int = 200
    memory_mb: float = 30.0
    memory_spread: float = 0.3
    load_s: float = 0.5
    load_spread: float = 0.3
    bundle_mb: float = 1.0


@dataclass(frozen=True, slots=True)
class Trainer:
    """One run: steps of groups, each group of one task sent as soon as it is written, as ``embomatrix train`` does.

    ``write_s`` is how long the policy writes the plans of a step, ``update_s`` how long the update after it takes.
    ``lookahead`` steps beside the present one are announced when a step begins. ``surprises`` is the share of announced
    scenes that turn out to be others.
    """

    name: str = "run"
    steps: int = 6
    groups: int = 32
    group_size: int = 16
    lookahead: int = 2
    write_s: float = 4.0
    update_s: float = 2.0
    latency_s: float = 0.0005
    surprises: float = 0.0
    start_s: float = 5.0
    """When its first step begins; workers have joined by then."""
    terms: RunTerms = field(default_factory=RunTerms)
    length: float = 1.0
    """How many times longer its rollouts take than the scenario's."""
    render: bool = False
    """Its rollouts need slots that render."""

    @property
    def rollouts(self) -> int:
        return self.steps * self.groups * self.group_size


@dataclass(frozen=True, slots=True)
class Faults:
    """What goes wrong. Rates are per second of one worker, shares per execution or load."""

    death_rate: float = 0.0
    silent_deaths: float = 0.5
    """Share of deaths that no connection tells of: power, network, a frozen machine."""
    respawn_s: float = 5.0
    partition_rate: float = 0.0
    partition_s: float = 5.0
    half_open: float = 0.5
    """Share of partitions that cut one direction only."""
    crash: float = 0.0
    """Executions that end their slot's process."""
    hang: float = 0.0
    """Executions that never end by themselves."""
    load_failure: float = 0.0
    slow_workers: float = 0.0
    """Share of workers that are slower than they say."""
    slowness: float = 10.0
    liars: int = 0
    """So many workers make results up …"""
    lies: float = 0.1
    """… for this share of their rollouts, each time another one."""


@dataclass(frozen=True, slots=True)
class ManagerPace:
    """How long the manager's one thread is taken by what it hears; by default by nothing, and it answers at once."""

    rollout_s: float = 0.0
    """By a rollout, all in all: charged when its result comes."""
    message_s: float = 0.0
    """By any other message of a worker."""


@dataclass(frozen=True, slots=True)
class SimulationScenario:
    """All that a simulation depends on: equal scenarios give equal histories."""

    seed: int = 0
    workers: int = 16
    kinds: tuple[MachineKind, ...] = (LOCAL,)
    scenes: Scenes = Scenes()
    execute_s: float = 0.05
    """Median of an execution on a machine of speed 1; log-normal."""
    execute_spread: float = 0.5
    trainers: tuple[Trainer, ...] = (Trainer(),)
    faults: Faults = Faults()
    dispatch: DispatchLimits = field(default_factory=DispatchLimits)
    schedule: ScheduleLimits = field(default_factory=ScheduleLimits)
    liveness: LivenessLimits = field(default_factory=LivenessLimits)
    manager: ManagerPace = ManagerPace()
    join_s: float = 2.0
    """Workers start within this time."""
    limit_s: float = 3600.0
    """A simulation that takes longer has failed."""

    @property
    def rollouts(self) -> int:
        return sum(trainer.rollouts for trainer in self.trainers)
