"""Scenarios: machines, scenes, trainers and faults as values. Times are seconds, sizes megabytes."""

from dataclasses import dataclass, field, replace

from embomatrix.manager.control.dispatch.state import DispatchLimits
from embomatrix.manager.control.schedule.scheduler import ScheduleLimits
from embomatrix.manager.runtime.registry import LivenessLimits
from embomatrix.rpc.wire.values import RunTerms


@dataclass(frozen=True, slots=True)
class MachineKind:
    """A kind of worker, which makes up ``share`` of all. ``speed`` divides load and execution times."""

    name: str
    share: float
    slots: int
    memory_mb: int
    speed: float
    latency_s: float
    """One-way latency to the manager."""
    bandwidth_mb_s: float
    """Bandwidth for bundles."""
    render_slots: int = 0
    """Number of its slots that render."""


LOCAL = MachineKind("server", 1.0, 8, 2048, 1.0, 0.0002, 100.0)
"""Server in the manager's network."""
MIXED = (
    MachineKind("server", 0.2, 16, 4096, 1.0, 0.0005, 100.0),
    MachineKind("workstation", 0.4, 8, 2048, 1.2, 0.001, 50.0),
    MachineKind("cloud VM", 0.2, 4, 1024, 0.8, 0.02, 25.0),
    MachineKind("spare PC", 0.2, 2, 512, 0.6, 0.06, 4.0),
)
"""Servers, workstations, cloud machines and idle home PCs."""
INTERNET = tuple(replace(kind, latency_s=0.08, bandwidth_mb_s=4.0) for kind in MIXED)
"""The same machines, all at a distance of 80 ms."""


@dataclass(frozen=True, slots=True)
class Scenes:
    """Scenes with log-normal sizes and load times, given by the median and the spread of the logarithm."""

    count: int = 200
    memory_mb: float = 30.0
    memory_spread: float = 0.3
    load_s: float = 0.5
    load_spread: float = 0.3
    bundle_mb: float = 1.0


@dataclass(frozen=True, slots=True)
class Trainer:
    """One run: steps of groups, each submitted as soon as its plans are written, as ``embomatrix train`` does."""

    name: str = "run"
    steps: int = 6
    groups: int = 32
    group_size: int = 16
    distinct: int = 0
    """Different plans in a group; 0: all are different."""
    lookahead: int = 2
    """Steps announced beside the present one."""
    write_s: float = 4.0
    """Time to write the plans of a step."""
    update_s: float = 2.0
    """Time of the policy update after a step."""
    latency_s: float = 0.0005
    surprises: float = 0.0
    """Share of announced scenes that are replaced by others."""
    start_s: float = 5.0
    """Start of its first step; workers have joined by then."""
    terms: RunTerms = field(default_factory=RunTerms)
    length: float = 1.0
    """Factor on the scenario's execution times."""
    render: bool = False
    """Its rollouts need slots that render."""

    @property
    def rollouts(self) -> int:
        return self.steps * self.groups * self.group_size


@dataclass(frozen=True, slots=True)
class Faults:
    """Faults. Rates are per second and worker, shares per execution or load."""

    death_rate: float = 0.0
    silent_deaths: float = 0.5
    """Share of deaths that break no connection: power, network, a frozen machine."""
    respawn_s: float = 5.0
    partition_rate: float = 0.0
    partition_s: float = 5.0
    half_open: float = 0.5
    """Share of partitions that cut only one direction."""
    crash: float = 0.0
    """Share of executions that crash their slot's process."""
    hang: float = 0.0
    """Share of executions that never end by themselves."""
    load_failure: float = 0.0
    slow_workers: float = 0.0
    """Share of workers that are ``slowness`` times slower than they claim."""
    slowness: float = 10.0
    liars: int = 0
    """Number of workers that invent results …"""
    lies: float = 0.1
    """… for this share of their rollouts, a different one each time."""


@dataclass(frozen=True, slots=True)
class ManagerPace:
    """Time that the manager's thread needs per message. By default it answers at once."""

    rollout_s: float = 0.0
    """Total time per rollout, charged with its result."""
    message_s: float = 0.0
    """Time per other message of a worker."""


@dataclass(frozen=True, slots=True)
class SimulationScenario:
    """All inputs of a simulation: equal scenarios give equal histories."""

    seed: int = 0
    workers: int = 16
    kinds: tuple[MachineKind, ...] = (LOCAL,)
    scenes: Scenes = Scenes()
    execute_s: float = 0.05
    """Median of the log-normal execution time on a machine of speed 1."""
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
    """Simulated time after which the simulation has failed."""

    @property
    def rollouts(self) -> int:
        return sum(trainer.rollouts for trainer in self.trainers)
