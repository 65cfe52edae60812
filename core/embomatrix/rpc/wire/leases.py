"""What manager and workers tell one another of leases, as values; ``rpc.convert_session`` maps them to the wire."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.reward.settings import PAPER, RewardSettings

if TYPE_CHECKING:
    from embomatrix.rpc.wire.values import Completed, InfraFailure, Resident, Rollout


@dataclass(frozen=True, slots=True)
class LeaseRef:
    """Names a lease. A result counts only under the epoch that the manager holds."""

    lease_id: str
    lease_epoch: int


@dataclass(frozen=True, slots=True)
class LeaseOrigin:
    """Which rollout a lease is for, and which attempt at it, from 1."""

    run_id: str
    batch_id: str
    rollout_id: str
    attempt: int = 1


@dataclass(frozen=True, slots=True)
class LeaseClaim:
    """A worker holds this lease, or its result: a manager that did not give it may take it up."""

    ref: LeaseRef
    origin: LeaseOrigin


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to execute one rollout. ``deadline_s`` is how long the execution may take, from its start."""

    ref: LeaseRef
    rollout: Rollout
    deadline_s: float
    origin: LeaseOrigin | None = None
    """None from a manager that does not take leases up."""
    reward: RewardSettings = PAPER
    """How the run wants it scored."""


@dataclass(frozen=True, slots=True)
class LeaseResult:
    """What became of a lease. It ran in ``slot``, counted from 1, for ``held_s`` seconds; 0 when it never ran.

    ``origin`` stays with the worker, and travels in its claims.
    """

    ref: LeaseRef
    outcome: Completed | InfraFailure
    origin: LeaseOrigin | None = None
    slot: int = 0
    held_s: float = 0.0


@dataclass(frozen=True, slots=True)
class LeaseProgress:
    """Steps of the plan that a lease which runs has done; the number never falls."""

    ref: LeaseRef
    steps: int


@dataclass(frozen=True, slots=True)
class WorkerState:
    """Everything that a worker holds. ``finished`` are results that no one has acknowledged yet.

    ``claims`` tell what the leases of both are for; only the first state of a stream has them.
    """

    residents: tuple[Resident, ...] = ()
    running: tuple[LeaseRef, ...] = ()
    finished: tuple[LeaseResult, ...] = ()
    draining: bool = False
    paused: str = ""
    """Why the worker takes nothing new for now, though it stays; empty while it works."""
    claims: tuple[LeaseClaim, ...] = ()
