"""Facts that reach the manager's state machines. Nothing here does I/O; times are seconds of one monotonic clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.manager.control.audit.auditor import Repute
    from embomatrix.rpc.wire.leases import LeaseClaim, LeaseProgress, LeaseRef
    from embomatrix.rpc.wire.values import (
        Batch,
        Completed,
        InfraFailure,
        LookaheadEntry,
        Resident,
        Resources,
        RunTerms,
    )


@dataclass(frozen=True, slots=True)
class WorkerJoined:
    """A worker registered. It gets work once it has reported its state."""

    worker_id: str
    resources: Resources


@dataclass(frozen=True, slots=True)
class WorkerReported:
    """The worker's full state. ``resync`` marks the first report of a stream: what it does not hold was never received.

    ``held`` are the leases that run or wait there, and with a first report also those whose results come with it.
    """

    worker_id: str
    residents: tuple[Resident, ...]
    held: tuple[LeaseRef, ...] = ()
    draining: bool = False
    resync: bool = False
    claims: tuple[LeaseClaim, ...] = ()
    paused: str = ""
    """Why it takes nothing new for now; empty while it works."""


@dataclass(frozen=True, slots=True)
class WorkerSuspected:
    """Heartbeats are missing: no new leases until it is heard again."""

    worker_id: str


@dataclass(frozen=True, slots=True)
class WorkerRecovered:
    """A suspected worker was heard again."""

    worker_id: str


@dataclass(frozen=True, slots=True)
class WorkerLost:
    """The worker is gone: crashed, silent for too long, or replaced by a newer session of the same id."""

    worker_id: str
    reason: str


@dataclass(frozen=True, slots=True)
class WorkerDrained:
    """An operator takes the worker out: it finishes what it holds and gets nothing new."""

    worker_id: str


@dataclass(frozen=True, slots=True)
class WorkerResumed:
    """An operator takes the drain back."""

    worker_id: str


@dataclass(frozen=True, slots=True)
class WorkerQuarantined:
    """Its results were found to be wrong: it gets nothing more until an operator resumes it."""

    worker_id: str


@dataclass(frozen=True, slots=True)
class LeasesRenewed:
    """A heartbeat named the leases that the worker still holds, and how far those have come that run."""

    worker_id: str
    held: tuple[LeaseRef, ...]
    progress: tuple[LeaseProgress, ...] = ()


@dataclass(frozen=True, slots=True)
class LeaseFinished:
    """A worker reported the end of a lease. It may be late or a repetition: the epoch tells."""

    worker_id: str
    ref: LeaseRef
    outcome: Completed | InfraFailure


@dataclass(frozen=True, slots=True)
class RunOpened:
    """A run asks for these terms. One that never said so has the defaults."""

    run_id: str
    terms: RunTerms


@dataclass(frozen=True, slots=True)
class BatchSubmitted:
    """A trainer wants these plans executed. The first ``count`` are queued now, the others as ``BatchContinued`` says."""

    batch: Batch
    count: int | None = None
    """None for all."""


@dataclass(frozen=True, slots=True)
class BatchContinued:
    """The next ``count`` rollouts of a batch are queued: a large one is taken in pieces, with other events between them."""

    run_id: str
    batch_id: str
    count: int


@dataclass(frozen=True, slots=True)
class BatchRestored:
    """A former manager took this batch. ``delivered`` maps rollouts to the cursors under which it delivered them.

    What is left may run somewhere: it waits for the workers to come back before it is given to others.
    """

    batch: Batch
    delivered: Mapping[str, int] = field(default_factory=dict)
    infra_failures: int = 0
    """Of those that were delivered."""


@dataclass(frozen=True, slots=True)
class WorkersExpected:
    """These were there under the former manager: once all of them have reported, nobody else can hold a lease of it."""

    worker_ids: frozenset[str]


@dataclass(frozen=True, slots=True)
class ReputesKnown:
    """What former managers found out about workers, by their ids."""

    reputes: Mapping[str, Repute]


@dataclass(frozen=True, slots=True)
class BatchCancelled:
    run_id: str
    batch_id: str


@dataclass(frozen=True, slots=True)
class RunClosed:
    """The run is over: open batches are cancelled and its look-ahead is forgotten."""

    run_id: str


@dataclass(frozen=True, slots=True)
class LookaheadAnnounced:
    """The whole window of a run. A version at or below the last one is ignored."""

    run_id: str
    version: int
    entries: tuple[LookaheadEntry, ...]


@dataclass(frozen=True, slots=True)
class DemandObserved:
    """What the Task-Dispatcher needs now.

    ``pending`` counts waiting rollouts by scene, and those that run for too long and would be started elsewhere as well.
    ``waited_s`` says how long the first of each has waited, whose turn it is first, and ``runs`` whose it is; ``rendering``
    are the scenes that need slots which render. ``in_use`` are the (worker, scene) pairs with live leases, ``used`` those
    that were given a lease since the last observation.
    ``idle`` are the workers that have a free slot and nothing to do with it; nobody is named while nothing is pending.
    """

    pending: Mapping[str, int]
    waited_s: Mapping[str, float] = field(default_factory=dict)
    in_use: frozenset[tuple[str, str]] = frozenset()
    used: frozenset[tuple[str, str]] = frozenset()
    idle: frozenset[str] = frozenset()
    runs: Mapping[str, str] = field(default_factory=dict)
    rendering: frozenset[str] = frozenset()
    lags: Mapping[str, float] = field(default_factory=dict)
    """How many times slower than others those workers are that plainly are."""


@dataclass(frozen=True, slots=True)
class ScenesUnplaceable:
    """The Resource-Scheduler finds no worker for these scenes; the reason of each, in words."""

    reasons: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class DispatchPaused:
    """An operator wants no new leases for now."""


@dataclass(frozen=True, slots=True)
class DispatchResumed:
    """Leases are given again."""


@dataclass(frozen=True, slots=True)
class Tick:
    """Time has passed: deadlines and expiries are due."""


Event = (
    WorkerJoined
    | WorkerReported
    | WorkerSuspected
    | WorkerRecovered
    | WorkerLost
    | WorkerDrained
    | WorkerResumed
    | WorkerQuarantined
    | LeasesRenewed
    | LeaseFinished
    | RunOpened
    | BatchSubmitted
    | BatchContinued
    | BatchRestored
    | WorkersExpected
    | ReputesKnown
    | BatchCancelled
    | RunClosed
    | LookaheadAnnounced
    | DemandObserved
    | ScenesUnplaceable
    | DispatchPaused
    | DispatchResumed
    | Tick
)
