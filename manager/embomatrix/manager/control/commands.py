"""Commands of the manager's state machines; the runtime carries them out."""

from dataclasses import dataclass, field

from embomatrix.manager.control.events import Event
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.leases import LeaseOrigin, LeaseRef
from embomatrix.rpc.wire.values import Rollout, RolloutResult


@dataclass(frozen=True, slots=True)
class ManagerCommand:
    """Order of a state machine to the runtime."""

    cause: Event | None = field(default=None, kw_only=True, compare=False, repr=False)
    """Event that led to the command."""


@dataclass(frozen=True, slots=True)
class SetDesired(ManagerCommand):
    """The worker should hold these scenes, most urgent first; it may evict all others."""

    worker_id: str
    bundle_digests: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class GiveLease(ManagerCommand):
    """The worker executes the rollout within ``deadline_s`` seconds of execution."""

    worker_id: str
    ref: LeaseRef
    rollout: Rollout
    deadline_s: float
    origin: LeaseOrigin
    """Returned in the worker's claims after a restart of the manager."""
    hedge: bool = False
    """Second lease of a rollout whose first is late and still live."""
    audit: bool = False
    """The result is compared with another worker's. Never sent to the worker."""
    reward: RewardSettings = PAPER


@dataclass(frozen=True, slots=True)
class CancelLease(ManagerCommand):
    """The lease is void: the worker stops or forgets it."""

    worker_id: str
    ref: LeaseRef


@dataclass(frozen=True, slots=True)
class AcknowledgeLease(ManagerCommand):
    """The worker may forget the result: it was taken, or it is stale."""

    worker_id: str
    ref: LeaseRef


@dataclass(frozen=True, slots=True)
class DeliverResult(ManagerCommand):
    """The one outcome of a rollout."""

    run_id: str
    batch_id: str
    result: RolloutResult


@dataclass(frozen=True, slots=True)
class FinishBatch(ManagerCommand):
    """Every rollout of the batch has its outcome."""

    run_id: str
    batch_id: str


@dataclass(frozen=True, slots=True)
class QuarantineWorker(ManagerCommand):
    """The worker's results are wrong and it gets no more work. Reported to operators, not to the worker."""

    worker_id: str
    reason: str
    audited: int
    """Number of its executions compared so far, including the wrong one."""
