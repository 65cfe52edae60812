"""Orders that the manager's state machines give; the runtime carries them out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.reward.settings import PAPER, RewardSettings

if TYPE_CHECKING:
    from embomatrix.rpc.wire.leases import LeaseOrigin, LeaseRef
    from embomatrix.rpc.wire.values import Rollout, RolloutResult


@dataclass(frozen=True, slots=True)
class SetDesired:
    """The full set of scenes that the worker should hold, most urgent first; others may be evicted."""

    worker_id: str
    bundle_digests: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class GiveLease:
    """The worker shall execute the rollout, within ``deadline_s`` seconds of execution.

    ``hedge`` marks the second lease of a rollout whose first is late and still good.
    """

    worker_id: str
    ref: LeaseRef
    rollout: Rollout
    deadline_s: float
    origin: LeaseOrigin
    """Comes back in the worker's claims when another manager asks."""
    hedge: bool = False
    audit: bool = False
    """The result is compared with another's: a worker is not told."""
    reward: RewardSettings = PAPER
    """How the run wants it scored."""


@dataclass(frozen=True, slots=True)
class CancelLease:
    """The lease is void: stop it if it runs, forget it if it waits."""

    worker_id: str
    ref: LeaseRef


@dataclass(frozen=True, slots=True)
class AcknowledgeLease:
    """The worker may forget the result; it was taken, or it came too late."""

    worker_id: str
    ref: LeaseRef


@dataclass(frozen=True, slots=True)
class DeliverResult:
    """The one terminal outcome of a rollout."""

    run_id: str
    batch_id: str
    result: RolloutResult


@dataclass(frozen=True, slots=True)
class FinishBatch:
    """Every rollout of the batch has its outcome."""

    run_id: str
    batch_id: str


@dataclass(frozen=True, slots=True)
class QuarantineWorker:
    """The worker's results are wrong: it gets nothing more. Told to people, not to the worker."""

    worker_id: str
    reason: str
    audited: int
    """Executions of it that had been compared, with the one that was wrong."""


Command = (
    SetDesired | GiveLease | CancelLease | AcknowledgeLease | DeliverResult | FinishBatch | QuarantineWorker
)
