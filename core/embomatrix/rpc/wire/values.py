"""What trainer, manager and workers tell one another, as values; ``rpc.convert`` maps them to the wire.

An outcome is a union: a failure of the infrastructure is a type without a reward, so it is never a 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar, Self

from embomatrix.reward.settings import PAPER, RewardSettings

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from embomatrix.reward.breakdown import RewardBreakdown
    from embomatrix.skills.syntax import Plan
    from embomatrix.skills.trace import Step

    Reader = Callable[[bytes], Mapping[str, object]]


class _ReadWhenAsked:
    """A value that is passed on more often than it is looked at: some of its slots stay empty until one of them is asked for.

    Then all of them are read from its message, by the function that it was made with.
    """

    __slots__ = ()
    _left: ClassVar[frozenset[str]]
    """The slots that may be empty."""

    @classmethod
    def _unread(cls, read: Reader, **known: object) -> Self:
        value = object.__new__(cls)
        for name, content in (*known.items(), ("read", read)):
            object.__setattr__(value, name, content)
        return value

    if not TYPE_CHECKING:  # else a type checker would believe that there are attributes of any name

        def __getattr__(self, name: str) -> object:
            """Called for what is in no slot."""
            if name not in self._left:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            for field_name, content in self.read(self.wire).items():
                object.__setattr__(self, field_name, content)
            return object.__getattribute__(self, name)


@dataclass(frozen=True, slots=True)
class Rollout(_ReadWhenAsked):
    """One plan to execute once. The plans of one task in one batch share ``group_id`` and ``seed``."""

    _left = frozenset({"rollout_id", "group_id", "task_id", "plan", "seed", "render"})

    rollout_id: str
    group_id: str
    bundle_digest: str
    task_id: str
    plan: Plan
    seed: int
    render: bool = False
    """It needs a slot that renders on a GPU."""
    wire: bytes = field(default=b"", init=False, compare=False, repr=False)
    """The message that it came in, which is passed on instead of written anew; a changed copy has none."""
    read: Reader | None = field(default=None, init=False, compare=False, repr=False)
    """Reads the rest from ``wire`` when it is first asked for; None where it was read at once."""

    @classmethod
    def unread(cls, wire: bytes, read: Reader, *, bundle_digest: str) -> Rollout:
        """A rollout of which only the scene is known, until somebody asks ``read`` for the rest."""
        return cls._unread(read, wire=wire, bundle_digest=bundle_digest)


@dataclass(frozen=True, slots=True)
class Batch:
    """What a trainer submits at once. The same id and content attaches again instead of executing twice."""

    run_id: str
    batch_id: str
    step: int
    rollouts: tuple[Rollout, ...]
    wire: bytes = field(default=b"", init=False, compare=False, repr=False)
    """The message that it came in, as for a rollout."""


@dataclass(frozen=True, slots=True)
class Timings:
    """Where the seconds of a rollout went. Durations only: clocks of two machines are never compared."""

    queued_s: float = 0.0
    """From submission to the lease that delivered, on the manager's clock."""
    load_s: float = 0.0
    """Waiting for the scene, on the worker's clock; 0 when it was warm."""
    execute_s: float = 0.0
    """In the slot, on the worker's clock."""
    lease_s: float = 0.0
    """The lease's life less loading and executing: the network and the wait for a slot, on the manager's clock."""
    deliver_s: float = 0.0
    """From the result's arrival to its row in the result log, on the manager's clock."""


@dataclass(frozen=True, slots=True)
class Completed(_ReadWhenAsked):
    """The plan was executed and scored: evidence about the policy, whatever the reward."""

    _left = frozenset({"reward", "steps", "final", "trace_digest"})

    reward: RewardBreakdown
    steps: tuple[Step, ...]
    final: tuple[str, ...]
    trace_digest: str
    worker_id: str
    timings: Timings
    warm: bool
    wire: bytes = field(default=b"", init=False, compare=False, repr=False)
    """The message that it came in, which is passed on instead of written anew, but for what was ``noted``; a copy that was
    changed otherwise has none."""
    read: Reader | None = field(default=None, init=False, compare=False, repr=False)
    """Reads from ``wire`` what is not noted, when it is first asked for; None where it was read at once."""

    @classmethod
    def unread(
        cls, wire: bytes, read: Reader, *, timings: Timings, warm: bool, worker_id: str = ""
    ) -> Completed:
        """A result of which only what is noted on its way is known, until somebody asks ``read`` for the rest."""
        return cls._unread(read, wire=wire, timings=timings, warm=warm, worker_id=worker_id)

    def noted(
        self, *, timings: Timings | None = None, worker_id: str | None = None, warm: bool | None = None
    ) -> Completed:
        """The same result with what is noted on its way."""
        timings = self.timings if timings is None else timings
        worker_id = self.worker_id if worker_id is None else worker_id
        warm = self.warm if warm is None else warm
        if self.read is not None:
            return Completed.unread(self.wire, self.read, timings=timings, warm=warm, worker_id=worker_id)
        copy = Completed(self.reward, self.steps, self.final, self.trace_digest, worker_id, timings, warm)
        object.__setattr__(copy, "wire", self.wire)
        return copy


class InfraCode(StrEnum):
    """Why the infrastructure could not execute a rollout. None of these says anything about the plan."""

    WORKER_LOST = "worker_lost"
    LEASE_EXPIRED = "lease_expired"
    SLOT_CRASHED = "slot_crashed"
    SLOT_TIMEOUT = "slot_timeout"
    SCENE_LOAD_FAILED = "scene_load_failed"
    BUNDLE_CORRUPT = "bundle_corrupt"
    NO_CAPACITY = "no_capacity"
    DEADLINE = "deadline"
    MANAGER_RESTARTED = "manager_restarted"
    STALLED = "stalled"
    SLOT_OOM = "slot_oom"
    VERSION_SKEW = "version_skew"
    RESULT_MISMATCH = "result_mismatch"


@dataclass(frozen=True, slots=True)
class InfraFailure:
    """The rollout has no result and no reward. ``message`` is the worker's or manager's own text."""

    code: InfraCode
    message: str
    worker_id: str = ""


@dataclass(frozen=True, slots=True)
class Cancelled:
    """Called off before it ended: by the trainer, or because its group or batch can't be completed any more."""

    reason: str = ""


Outcome = Completed | InfraFailure | Cancelled


@dataclass(frozen=True, slots=True)
class RolloutResult:
    """The one terminal outcome of a rollout. ``cursor`` orders the results of a batch from 1."""

    rollout_id: str
    group_id: str
    cursor: int
    attempt: int
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class GroupDone:
    """Every member of a group has its outcome: how many of each kind."""

    group_id: str
    completed: int = 0
    infra_failures: int = 0
    cancelled: int = 0


class GroupPolicy(StrEnum):
    """What becomes of a group when one of its rollouts ends as a failure of the infrastructure."""

    RETRY_THEN_FAIL_GROUP = "retry_then_fail_group"
    """After the retries the others are cancelled: the group is left out of the update as a whole."""
    PARTIAL = "partial"
    """The others go on."""
    FAIL_FAST = "fail_fast"
    """No retries: the first failure cancels the whole batch."""


@dataclass(frozen=True, slots=True)
class RunTerms:
    """What a run asks of the cluster. A higher ``priority`` is served first, equal ones share by ``weight``."""

    group_policy: GroupPolicy = GroupPolicy.RETRY_THEN_FAIL_GROUP
    weight: float = 1.0
    priority: int = 0
    rollout_deadline_s: float = 0.0
    """From submission to outcome; 0 for the manager's default."""
    verified: bool = False
    """Results of workers on probation, and some of the others, are delivered when a second worker came to the same."""
    reward: RewardSettings = PAPER
    """Coefficients of the reward's tiers, for all rollouts of the run."""


class Warmth(StrEnum):
    """How far the manager is with a scene that was announced."""

    WARM = "warm"
    WARMING = "warming"
    QUEUED = "queued"
    UNPLACEABLE = "unplaceable"


@dataclass(frozen=True, slots=True)
class LookaheadEntry:
    """One scene that a coming step needs: ``count`` rollouts of it at ``step``."""

    step: int
    bundle_digest: str
    count: int
    render: bool = False
    """They need slots that render on a GPU."""


@dataclass(frozen=True, slots=True)
class LookaheadAnswer:
    """How far a scene is. ``eta_s`` are the seconds until it is warm: 0 when it is, or when nobody can tell."""

    bundle_digest: str
    warmth: Warmth
    eta_s: float = 0.0
    reason: str = ""
    """Why no worker can hold it."""


@dataclass(frozen=True, slots=True)
class PlanCell:
    """One cell of the look-ahead grid. ``worker_ids`` hold the scene or load it."""

    run_id: str
    step: int
    bundle_digest: str
    count: int
    warmth: Warmth
    worker_ids: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Resources:
    """What a worker offers. ``memory_mb`` is for all residents together; ``score`` is its measured speed."""

    slots: int
    cores: int
    memory_mb: int
    score: float = 1.0
    gpu: str = ""
    vram_mb: int = 0
    versions: Mapping[str, str] = field(default_factory=dict)
    """Of the package, Python, the engine's wheel, and the platform fingerprint."""
    render_slots: int = 0
    """Slots of them that render on the GPU."""
    disk_mb: int = 0
    """Free space for bundles."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """What the operator calls this machine by: room=lab, owner=ann."""


@dataclass(frozen=True, slots=True)
class RunStats:
    """Counters of a run, as the manager keeps them."""

    delivered: int = 0
    infra_failures: int = 0
    redispatched: int = 0
    stale_results: int = 0
    warm_starts: int = 0
    cold_starts: int = 0
    prewarm_hits: int = 0
    prewarm_misses: int = 0
    prewarm_wasted: int = 0
    hedged: int = 0
    groups_failed: int = 0
    audited: int = 0
    """Results that were compared with those of another worker."""
    audit_mismatches: int = 0
    """Of these: where the two were not the same."""


class ResidentState(StrEnum):
    """How far a worker is with a scene that it should hold."""

    LOADING = "loading"
    WARM = "warm"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Resident:
    """A scene on a worker. ``error`` says why loading it failed; ``memory_mb`` is what it holds alone."""

    bundle_digest: str
    state: ResidentState
    load_s: float = 0.0
    memory_mb: float = 0.0
    error: str = ""


@dataclass(frozen=True, slots=True)
class WorkerInfo:
    """A worker as the manager sees it. ``state`` is "ready", "paused", "suspect", "lost", "draining", "quarantined", "left"."""

    worker_id: str
    state: str
    resources: Resources
    residents: tuple[Resident, ...]
    running: int
    completed: int
    last_seen_s: float
    reason: str = ""
    """Why it is paused, draining, lost or in quarantine."""
    audited: int = 0
    """Executions that were compared with others'."""
    audit_mismatches: int = 0
    """Of these: in which a majority contradicted it."""


@dataclass(frozen=True, slots=True)
class FleetStatus:
    """The workers, and how the cluster does, in the manager's own sentence; a manager of an earlier release says nothing.

    ``mood`` is how much somebody should care: good, idle, warning or bad.
    """

    workers: tuple[WorkerInfo, ...]
    health: str = ""
    mood: str = ""


@dataclass(frozen=True, slots=True)
class RunInfo:
    """A run: its counters so far, and how many of its rollouts have no outcome yet.

    Times are seconds since the epoch on the manager's clock; ``closed_s`` is 0 while it is open.
    """

    run_id: str
    name: str
    stats: RunStats
    pending: int
    opened_s: float = 0.0
    closed_s: float = 0.0
    reward: RewardSettings = PAPER
    waits_for: str = ""
    """Why rollouts of it can't be executed by any worker that is there; empty while they can."""
