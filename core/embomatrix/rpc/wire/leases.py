"""Lease values that manager and workers exchange; ``wire.session`` converts them to and from protobuf."""

from dataclasses import dataclass

from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.values import Completed, InfraFailure, Resident, Rollout


@dataclass(frozen=True, slots=True)
class LeaseRef:
    """Name of a lease. A result counts only under the epoch that the manager holds."""

    lease_id: str
    lease_epoch: int


@dataclass(frozen=True, slots=True)
class LeaseOrigin:
    """Rollout that a lease is for, and the attempt at it, from 1."""

    run_id: str
    batch_id: str
    rollout_id: str
    attempt: int = 1


@dataclass(frozen=True, slots=True)
class LeaseClaim:
    """Claim of a worker to a lease that it runs or has finished. A manager that did not give the lease may adopt it."""

    ref: LeaseRef
    origin: LeaseOrigin


@dataclass(frozen=True, slots=True)
class Lease:
    """Right to execute one rollout. ``deadline_s`` limits the execution time."""

    ref: LeaseRef
    rollout: Rollout
    deadline_s: float
    origin: LeaseOrigin | None = None
    """None in a message without it."""
    reward: RewardSettings = PAPER
    """Reward coefficients of the run."""


@dataclass(frozen=True, slots=True)
class LeaseResult:
    """Result of a lease, which ran in ``slot`` (from 1; 0: never) for ``held_s`` seconds.

    ``origin`` stays on the worker and travels in its claims; ``awaited`` stays there too.
    """

    ref: LeaseRef
    outcome: Completed | InfraFailure
    origin: LeaseOrigin | None = None
    slot: int = 0
    held_s: float = 0.0
    awaited: bool = False
    """A client waits for it, as for every turn of an episode, so it is sent at once."""


@dataclass(frozen=True, slots=True)
class LeaseProgress:
    """Number of plan steps that a running lease has executed. It never falls."""

    ref: LeaseRef
    steps: int


@dataclass(frozen=True, slots=True)
class WorkerState:
    """Full state of a worker. ``finished`` are results without acknowledgement.

    ``claims`` give the origin of running and finished leases. Only the first state of a stream has them.
    """

    residents: tuple[Resident, ...] = ()
    running: tuple[LeaseRef, ...] = ()
    finished: tuple[LeaseResult, ...] = ()
    draining: bool = False
    paused: str = ""
    """Reason why the worker accepts no new leases; empty while it accepts them."""
    claims: tuple[LeaseClaim, ...] = ()
