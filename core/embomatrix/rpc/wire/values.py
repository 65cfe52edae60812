"""Values that trainer, manager and workers exchange.

An outcome is a union: an infrastructure failure is a type without a reward, so it never counts as a reward of 0.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar, Final, Self

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.skills.syntax import Plan
from embomatrix.skills.trace import Step
from embomatrix.skills.turns import EpisodePrefix, TurnObservation

Reader = Callable[[bytes], object]


class _ReadWhenAsked:
    """Value that is parsed from its message on first access, because most processes only pass it on.

    The first access to an empty slot fills all empty slots.
    """

    __slots__ = ()
    _left: ClassVar[frozenset[str]]
    """Slots that may be empty."""

    @classmethod
    def unread(cls, wire: bytes, read: Reader, **known: object) -> Self:
        """Return a value of which only the ``known`` fields are parsed."""
        value = object.__new__(cls)
        for name, content in (*known.items(), ("wire", wire), ("read", read)):
            object.__setattr__(value, name, content)
        return value

    if not TYPE_CHECKING:  # Otherwise a type checker would accept attributes of any name.

        def __getattr__(self, name: str) -> object:
            if name not in self._left:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            whole = self.read(self.wire)
            for field_name in self._left:
                object.__setattr__(self, field_name, getattr(whole, field_name))
            return object.__getattribute__(self, name)


@dataclass(frozen=True, slots=True)
class Rollout(_ReadWhenAsked):
    """One plan to execute once. The plans of one task in one batch share ``group_id`` and ``seed``."""

    _left = frozenset(
        {"rollout_id", "group_id", "task_id", "plan", "seed", "render", "also", "prefix", "sight", "advise"}
    )

    rollout_id: str
    group_id: str
    bundle_digest: str
    task_id: str
    plan: Plan
    seed: int
    render: bool = False
    """Needs a slot that renders on a GPU."""
    also: tuple[str, ...] = ()
    """Ids of further rollouts of the group that are equal in everything else: one execution serves all."""
    prefix: EpisodePrefix | None = None
    """Calls of the plan that its episode has made before, if this is a turn of an episode."""
    sight: bool = False
    """The observation of this turn says what the robot sees. Such a turn may have no call after its prefix."""
    advise: bool = False
    """The observation of this turn has the oracle's advice. Such a turn may have no call after its prefix."""
    wire: bytes = field(default=b"", init=False, compare=False, repr=False)
    """Original message, which is passed on unchanged; a modified copy has none."""
    read: Reader | None = field(default=None, init=False, compare=False, repr=False)
    """Parser of ``wire`` for the empty slots; None once everything is parsed."""

    @property
    def count(self) -> int:
        """Number of rollouts that this one stands for."""
        return 1 + len(self.also)

    @property
    def is_turn(self) -> bool:
        return self.prefix is not None

    @property
    def only_looks(self) -> bool:
        """True if the turn is useful without a new call."""
        return self.sight or self.advise


@dataclass(frozen=True, slots=True)
class Batch:
    """Rollouts that a trainer submits at once. Submitting the same id and content again attaches to the batch."""

    run_id: str
    batch_id: str
    step: int
    rollouts: tuple[Rollout, ...]
    wire: bytes = field(default=b"", init=False, compare=False, repr=False)
    """Original message, as for a rollout."""

    @property
    def count(self) -> int:
        """Number of rollouts."""
        return sum(rollout.count for rollout in self.rollouts)

    @property
    def has_turns(self) -> bool:
        """True if its rollouts are turns of episodes: then all are."""
        return bool(self.rollouts) and self.rollouts[0].is_turn


@dataclass(frozen=True, slots=True)
class Timings:
    """Durations of a rollout. Clocks of two machines are never compared."""

    queued_s: float = 0.0
    """Time between submission and the lease that delivered, on the manager's clock."""
    load_s: float = 0.0
    """Wait for the scene, on the worker's clock; 0 if it was warm."""
    execute_s: float = 0.0
    """Time in the slot, on the worker's clock."""
    lease_s: float = 0.0
    """Life of the lease minus loading and executing: network and wait for a slot, on the manager's clock."""
    deliver_s: float = 0.0
    """Time between the result's arrival and its row in the result log, on the manager's clock."""


@dataclass(frozen=True, slots=True)
class Completed(_ReadWhenAsked):
    """Executed and scored plan: evidence about the policy, with any reward."""

    _left = frozenset({"reward", "steps", "final", "trace_digest", "shared_steps", "observation"})

    reward: RewardBreakdown
    steps: tuple[Step, ...]
    final: tuple[str, ...]
    trace_digest: str
    worker_id: str
    timings: Timings
    warm: bool
    shared_steps: int = field(default=0, compare=False)
    """Steps that were known from earlier rollouts and not executed. Equal plans may differ in it."""
    observation: TurnObservation | None = None
    """Observation of a turn, whose ``steps`` are those after its prefix."""
    wire: bytes = field(default=b"", init=False, compare=False, repr=False)
    """Original message, which is passed on with the ``noted`` fields replaced; a copy with other changes has none."""
    read: Reader | None = field(default=None, init=False, compare=False, repr=False)
    """Parser of ``wire`` for the empty slots; None once everything is parsed."""

    def noted(
        self, *, timings: Timings | None = None, worker_id: str | None = None, warm: bool | None = None
    ) -> Completed:
        """Return the same result with these fields replaced."""
        timings = self.timings if timings is None else timings
        worker_id = self.worker_id if worker_id is None else worker_id
        warm = self.warm if warm is None else warm
        if self.read is not None:
            return Completed.unread(
                self.wire, self.read, timings=timings, warm=warm, worker_id=worker_id, **self._checked()
            )
        copy = Completed(
            self.reward,
            self.steps,
            self.final,
            self.trace_digest,
            worker_id,
            timings,
            warm,
            self.shared_steps,
            self.observation,
        )
        object.__setattr__(copy, "wire", self.wire)
        return copy

    def _checked(self) -> dict[str, object]:
        """Return the values that a manager parses to check a result; none if they are not parsed."""
        try:
            return {name: object.__getattribute__(self, name) for name in _CHECKED}
        except AttributeError:
            return {}


_CHECKED: Final = ("reward", "steps", "shared_steps", "observation")


class InfraCode(StrEnum):
    """Reason why the infrastructure could not execute a rollout. It says nothing about the plan."""

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
    PREFIX_MISMATCH = "prefix_mismatch"


@dataclass(frozen=True, slots=True)
class InfraFailure:
    """Infrastructure failure: no result and no reward. ``message`` comes from the worker or the manager."""

    code: InfraCode
    message: str
    worker_id: str = ""


@dataclass(frozen=True, slots=True)
class Cancelled:
    """Rollout that was cancelled by the trainer, or because its group or batch cannot be completed."""

    reason: str = ""


Outcome = Completed | InfraFailure | Cancelled


@dataclass(frozen=True, slots=True)
class RolloutResult:
    """Terminal outcome of a rollout. ``cursor`` orders the results of a batch from 1."""

    rollout_id: str
    group_id: str
    cursor: int
    attempt: int
    outcome: Outcome
    also: tuple[str, ...] = ()
    """Ids of equal rollouts with the same outcome."""

    @property
    def count(self) -> int:
        """Number of rollouts that have this outcome."""
        return 1 + len(self.also)

    def each(self) -> tuple[RolloutResult, ...]:
        """Return one result for each rollout. All steps of the further ones are shared."""
        if not self.also:
            return (self,)
        outcome = self.outcome
        if isinstance(outcome, Completed):
            outcome = dataclasses.replace(outcome, shared_steps=len(outcome.steps))
        first = dataclasses.replace(self, also=())
        further = (
            RolloutResult(name, self.group_id, self.cursor, self.attempt, outcome) for name in self.also
        )
        return (first, *further)


@dataclass(frozen=True, slots=True)
class GroupDone:
    """Number of outcomes of each kind in a finished group."""

    group_id: str
    completed: int = 0
    infra_failures: int = 0
    cancelled: int = 0


class GroupPolicy(StrEnum):
    """Treatment of a group after one of its rollouts ends in an infrastructure failure."""

    RETRY_THEN_FAIL_GROUP = "retry_then_fail_group"
    """Retry, then cancel the rest of the group, which is left out of the update."""
    PARTIAL = "partial"
    """The rest of the group continues."""
    FAIL_FAST = "fail_fast"
    """No retries: the first failure cancels the whole batch."""


@dataclass(frozen=True, slots=True)
class RunTerms:
    """Terms of a run. Runs of higher ``priority`` are served first; runs of equal priority share by ``weight``."""

    group_policy: GroupPolicy = GroupPolicy.RETRY_THEN_FAIL_GROUP
    weight: float = 1.0
    priority: int = 0
    rollout_deadline_s: float = 0.0
    """Time limit from submission to outcome; 0 for the manager's default."""
    verified: bool = False
    """Results of workers on probation, and a sample of others, are delivered after a second worker has reproduced
    them."""
    reward: RewardSettings = PAPER
    """Reward coefficients of all rollouts of the run."""


class Warmth(StrEnum):
    """Loading state of an announced scene."""

    WARM = "warm"
    WARMING = "warming"
    QUEUED = "queued"
    UNPLACEABLE = "unplaceable"


@dataclass(frozen=True, slots=True)
class LookaheadEntry:
    """Scene that a coming step needs, for ``count`` rollouts."""

    step: int
    bundle_digest: str
    count: int
    render: bool = False
    """Needs slots that render on a GPU."""


@dataclass(frozen=True, slots=True)
class LookaheadAnswer:
    """Loading state of a scene. ``eta_s`` is the forecast seconds until it is warm; 0 if it is warm or unknown."""

    bundle_digest: str
    warmth: Warmth
    eta_s: float = 0.0
    reason: str = ""
    """Reason why the scene fits on no worker."""


@dataclass(frozen=True, slots=True)
class PlanCell:
    """Cell of the look-ahead grid. Workers in ``worker_ids`` hold or load the scene."""

    run_id: str
    step: int
    bundle_digest: str
    count: int
    warmth: Warmth
    worker_ids: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Resources:
    """Resources of a worker. ``memory_mb`` is for all residents together; ``score`` is its measured speed."""

    slots: int
    cores: int
    memory_mb: int
    score: float = 1.0
    gpu: str = ""
    vram_mb: int = 0
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of the package, Python, the engine's wheel, and the platform fingerprint."""
    render_slots: int = 0
    """Number of slots that render on the GPU."""
    disk_mb: int = 0
    """Free space for bundles."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Labels that the operator gave this machine, such as room=lab."""


@dataclass(frozen=True, slots=True)
class RunStats:
    """Counters of a run."""

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
    """Results that were compared with another worker's."""
    audit_mismatches: int = 0
    """Audited results that differed from another worker's."""
    steps: int = 0
    """Steps of all completed rollouts."""
    shared_steps: int = 0
    """Steps that were known from equal plans or equal beginnings and not executed."""

    @property
    def shared_share(self) -> float:
        """Share of the steps that were not executed; 0 without any steps."""
        return self.shared_steps / self.steps if self.steps else 0.0


class ResidentState(StrEnum):
    """Loading state of a scene on a worker."""

    LOADING = "loading"
    WARM = "warm"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Resident:
    """Scene on a worker. ``error`` says why loading failed; ``memory_mb`` is its own memory."""

    bundle_digest: str
    state: ResidentState
    load_s: float = 0.0
    memory_mb: float = 0.0
    error: str = ""


@dataclass(frozen=True, slots=True)
class WorkerInfo:
    """Worker as the manager sees it. ``state`` is "ready", "paused", "suspect", "lost", "draining", "quarantined" or
    "left".
    """

    worker_id: str
    state: str
    resources: Resources
    residents: tuple[Resident, ...]
    running: int
    completed: int
    last_seen_s: float
    reason: str = ""
    """Reason why it is paused, draining, lost or in quarantine."""
    audited: int = 0
    """Executions that were compared with other workers'."""
    audit_mismatches: int = 0
    """Audited executions that a majority contradicted."""


@dataclass(frozen=True, slots=True)
class FleetStatus:
    """Workers, and the health of the cluster in a sentence.

    ``mood`` is its severity: good, idle, warning or bad.
    """

    workers: tuple[WorkerInfo, ...]
    health: str = ""
    mood: str = ""


@dataclass(frozen=True, slots=True)
class HostUse:
    """Use of a worker's machine by all its programs. ``cpu_share`` is the share of all cores, 0 to 1."""

    cpu_share: float
    memory_used_mb: int
    memory_mb: int


@dataclass(frozen=True, slots=True)
class RunInfo:
    """Run with its counters; ``pending`` rollouts have no outcome yet.

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
    """Reason why no connected worker can execute its rollouts; empty while one can."""
