"""What a manager remembers of a run: events in the order in which it saw them, and what they came to.

Times are seconds since the epoch on the manager's clock, durations are seconds of whoever measured them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.rpc.wire.values import RunInfo, Timings


class RolloutPhase(StrEnum):
    """Where the time of a rollout goes, in the order in which it goes there."""

    QUEUE = "queue"
    LEASE = "lease"
    LOAD = "load"
    EXECUTE = "execute"
    DELIVER = "deliver"


class EventKind(StrEnum):
    """What happened."""

    RUN_OPENED = "run_opened"
    RUN_CLOSED = "run_closed"
    SUBMITTED = "submitted"
    LEASED = "leased"
    COMPLETED = "completed"
    FAILED = "failed"
    ENDED = "ended"
    WORKER_JOINED = "worker_joined"
    WORKER_LOST = "worker_lost"
    SCENE_WARM = "scene_warm"
    SCENE_EVICTED = "scene_evicted"
    SCENE_FAILED = "scene_failed"


class RunEvent(NamedTuple):
    """One fact. What does not apply is empty; ``proto/admin_service`` says what each field means for which kind."""

    sequence: int
    at_s: float
    kind: EventKind
    run_id: str = ""
    batch_id: str = ""
    rollout_id: str = ""
    worker_id: str = ""
    bundle_digest: str = ""
    slot: int = 0
    attempt: int = 0
    code: str = ""
    message: str = ""
    timings: Timings | None = None
    held_s: float = 0.0
    size: int = 0


@dataclass(frozen=True, slots=True)
class PhaseSummary:
    """Durations of one phase. The quantiles are right to 4 %."""

    count: int = 0
    sum_s: float = 0.0
    p50_s: float = 0.0
    p95_s: float = 0.0
    p99_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RunWorker:
    """What a worker did for a run: leases that completed and failed, and the seconds it spent on them."""

    worker_id: str
    completed: int = 0
    failed: int = 0
    execute_s: float = 0.0
    load_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RunSeries:
    """Rollouts by outcome in each step of ``step_s`` seconds since the run was opened."""

    step_s: float
    completed: tuple[int, ...]
    failed: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class RunSummary:
    """What a run came to. ``manager_cpu_s`` is the manager's CPU time meanwhile, for whatever run."""

    run: RunInfo
    phases: Mapping[RolloutPhase, PhaseSummary]
    workers: tuple[RunWorker, ...]
    series: RunSeries
    failures: tuple[RunEvent, ...]
    """The latest, oldest first."""
    manager_cpu_s: float
    prewarm_lead: PhaseSummary
    scene_load: PhaseSummary
    events_dropped: int
    version: str


class RolloutStepKind(StrEnum):
    """Kinds of steps in the history of a rollout."""

    SUBMITTED = "submitted"
    QUEUED = "queued"
    LEASED = "leased"
    HEDGED = "hedged"
    REVOKED = "revoked"
    EXPIRED = "expired"
    RETURNED = "returned"
    HELD = "held"
    DELIVERED = "delivered"


class RolloutStep(NamedTuple):
    """One step in the history of a rollout. ``cause`` names the event that led to it."""

    at_s: float
    kind: RolloutStepKind
    run_id: str
    batch_id: str
    worker_id: str
    reason: str
    cause: str


@dataclass(frozen=True, slots=True)
class RolloutExplanation:
    """Recent history of a rollout. ``place`` is empty once it has its outcome."""

    steps: tuple[RolloutStep, ...]
    place: str


@dataclass(frozen=True, slots=True)
class EventPage:
    """Events in order. ``dropped`` of the log so far made room for later ones."""

    events: tuple[RunEvent, ...]
    dropped: int
