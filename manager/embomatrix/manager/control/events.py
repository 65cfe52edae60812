"""Events of the manager's state machines. Times are seconds of one monotonic clock."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from embomatrix.manager.control.reputation import Reputation
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
class Event:
    """Fact that the state machines react to."""


@dataclass(frozen=True, slots=True)
class WorkerJoined(Event):
    """A worker registered. It gets work after its first report."""

    worker_id: str
    resources: Resources


@dataclass(frozen=True, slots=True)
class WorkerReported(Event):
    """Full state of a worker."""

    worker_id: str
    residents: tuple[Resident, ...]
    held: tuple[LeaseRef, ...] = ()
    """Leases that run or wait there; in a first report, also those whose results come with it."""
    draining: bool = False
    resync: bool = False
    """First report of a stream: leases missing in ``held`` never arrived."""
    claims: tuple[LeaseClaim, ...] = ()
    paused: str = ""
    """The worker's reason to take nothing new for now; empty while it works."""


@dataclass(frozen=True, slots=True)
class SuspicionChanged(Event):
    """A worker became ``suspect`` because heartbeats are missing, or was heard again. A suspect gets no new leases."""

    worker_id: str
    suspect: bool


@dataclass(frozen=True, slots=True)
class WorkerLost(Event):
    """The worker crashed, was silent for too long, or was replaced by a newer session."""

    worker_id: str
    reason: str


@dataclass(frozen=True, slots=True)
class WorkerFaulted(Event):
    """A worker sent a message that no sound worker sends. It is quarantined."""

    worker_id: str
    reason: str


@dataclass(frozen=True, slots=True)
class DrainChanged(Event):
    """An operator drained a worker, which then only finishes its leases, or ended its drain and quarantine."""

    worker_id: str
    drained: bool


@dataclass(frozen=True, slots=True)
class LeasesRenewed(Event):
    """A heartbeat listed the leases that the worker holds, and the progress of the running ones."""

    worker_id: str
    held: tuple[LeaseRef, ...]
    progress: tuple[LeaseProgress, ...] = ()


@dataclass(frozen=True, slots=True)
class LeaseFinished(Event):
    """A worker reported the end of a lease. Late and repeated reports have an epoch that is not live."""

    worker_id: str
    ref: LeaseRef
    outcome: Completed | InfraFailure


@dataclass(frozen=True, slots=True)
class RunOpened(Event):
    """A run was opened with these terms. Runs that were never opened have the defaults."""

    run_id: str
    terms: RunTerms


@dataclass(frozen=True, slots=True)
class BatchSubmitted(Event):
    """A trainer submitted a batch. The first ``count`` rollouts are queued now, the others by ``BatchContinued``."""

    batch: Batch
    count: int | None = None
    """None queues all."""


@dataclass(frozen=True, slots=True)
class BatchContinued(Event):
    """Queue the next ``count`` rollouts of a large batch. Other events are handled in between."""

    run_id: str
    batch_id: str
    count: int


@dataclass(frozen=True, slots=True)
class BatchRestored(Event):
    """A batch of a former manager. Its other rollouts may still run on workers, so they wait for claims first."""

    batch: Batch
    delivered: Mapping[str, int] = field(default_factory=dict)
    """Cursor of each delivered rollout."""
    outcomes: int = 0
    """Delivered outcomes. Equal rollouts share a cursor, and each has its outcome."""
    infra_failures: int = 0
    """Infrastructure failures among the delivered outcomes."""


@dataclass(frozen=True, slots=True)
class WorkersExpected(Event):
    """Workers of the former manager. After all of them have reported, no other worker can hold a lease of it."""

    worker_ids: frozenset[str]


@dataclass(frozen=True, slots=True)
class ReputationsKnown(Event):
    """Reputations from former managers, by worker id."""

    reputations: Mapping[str, Reputation]


@dataclass(frozen=True, slots=True)
class BatchCancelled(Event):
    run_id: str
    batch_id: str


@dataclass(frozen=True, slots=True)
class RunClosed(Event):
    """The run ended: its open batches are cancelled and its look-ahead is dropped."""

    run_id: str


@dataclass(frozen=True, slots=True)
class LookaheadAnnounced(Event):
    """The whole look-ahead window of a run. A version at or below the last one is ignored."""

    run_id: str
    version: int
    entries: tuple[LookaheadEntry, ...]


@dataclass(frozen=True, slots=True)
class DemandObserved(Event):
    """Demand of the Task-Dispatcher for scenes."""

    pending: Mapping[str, int]
    """Waiting rollouts by scene, with late ones that would be hedged."""
    waited_s: Mapping[str, float] = field(default_factory=dict)
    """Longest wait of each scene's rollouts, in order of turns."""
    in_use: frozenset[tuple[str, str]] = frozenset()
    """(worker, scene) pairs with live leases."""
    used: frozenset[tuple[str, str]] = frozenset()
    """(worker, scene) pairs that got a lease since the last observation."""
    idle: frozenset[str] = frozenset()
    """Workers with a free slot; empty while nothing is pending."""
    runs: Mapping[str, str] = field(default_factory=dict)
    """Run whose turn is next, by scene."""
    rendering: frozenset[str] = frozenset()
    """Scenes that need slots that render."""
    lags: Mapping[str, float] = field(default_factory=dict)
    """Slowdown of each slow worker against the others."""


@dataclass(frozen=True, slots=True)
class ScenesUnplaceable(Event):
    """Scenes that the Resource-Scheduler finds no worker for, each with the reason."""

    reasons: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class PauseChanged(Event):
    """Dispatch was paused or resumed. While it is ``paused``, no leases are granted."""

    paused: bool


@dataclass(frozen=True, slots=True)
class Tick(Event):
    """Time has passed: deadlines and expiries are checked."""
