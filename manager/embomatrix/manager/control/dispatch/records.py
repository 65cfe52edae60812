"""Records of rollouts, leases, groups and batches in the dispatcher."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import NamedTuple

from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.leases import LeaseRef
from embomatrix.rpc.wire.values import Rollout, RunStats, Timings

FairShareTurn = tuple[float, float, int]
"""Sort key of waiting rollouts; the smallest goes first."""


class RolloutKey(NamedTuple):
    """Cluster-wide name of a rollout."""

    run_id: str
    batch_id: str
    rollout_id: str


class QueueKey(NamedTuple):
    """Rollouts of one run and scene with equal keys need the same kind of worker and slot: they share a queue."""

    run_id: str
    render: bool
    excluded_workers: frozenset[str]


class DispatchPhase(Enum):
    """State of a rollout in the dispatcher. DONE is final."""

    PENDING = auto()
    LEASED = auto()
    """Leased, held for an audit, or awaited from a former manager: in no queue."""
    DONE = auto()


@dataclass(slots=True, eq=False)
class RolloutRecord:
    """A rollout with those that are equal to it, or a check: a further execution of a rollout, made to compare results."""

    key: RolloutKey
    rollout: Rollout
    sequence: int
    """Queue position by submission order. A re-dispatched rollout keeps it."""
    submitted_s: float
    warm: bool
    """The scene was warm on some worker at submission."""
    phase: DispatchPhase = DispatchPhase.LEASED
    attempts: int = 0
    """Leases that started and brought no result."""
    leases: list[LeaseRecord] = field(default_factory=list)
    """Live leases: at most one, or two on different workers if ``hedged``. Empty unless ``phase`` is LEASED."""
    hedged: bool = False
    out_of_memory: bool = False
    """An attempt ran out of memory: the rollout is never hedged."""
    failed_on: str = ""
    """Worker of the last failed attempt; empty before."""
    avoid_until_s: float = -math.inf
    """Monotonic time from which ``failed_on`` may get the rollout again."""
    held: bool = False
    """Executed; the result waits until another worker has confirmed it. Only in phase LEASED, without ``leases``."""
    check: bool = False
    """A check is in no batch; its audit case owns it."""
    excluded_workers: frozenset[str] = frozenset()
    """Workers whose results a check verifies: they may not execute it."""
    reward: RewardSettings = PAPER
    queue: QueueKey = field(init=False)

    def __post_init__(self) -> None:
        self.queue = QueueKey(self.key.run_id, self.rollout.render, self.excluded_workers)

    @property
    def scene(self) -> str:
        return self.rollout.bundle_digest

    @property
    def count(self) -> int:
        """Number of rollouts that this record stands for."""
        return self.rollout.count


@dataclass(slots=True, eq=False)
class LeaseRecord:
    """A live lease. It expires at ``expires_s`` unless renewed, and at ``limit_s`` in any case."""

    ref: LeaseRef
    worker_id: str
    record: RolloutRecord
    given_s: float
    expires_s: float
    limit_s: float
    charged_s: float = 0.0
    """Slot time over weight that the run was charged in advance."""
    started_s: float | None = None
    """Time at which a slot became free for it, by the manager's reckoning; None while it is queued behind a slot."""
    steps: int = -1
    """Steps done, by the last heartbeat; -1 before the first progress report."""
    moved_s: float = 0.0
    """Time at which ``steps`` last rose."""

    @property
    def due_s(self) -> float:
        return min(self.expires_s, self.limit_s)

    def timings(self, reported: Timings, now_s: float) -> Timings:
        """Return the worker's timings with the queue and lease times of a lease that ends now."""
        lease_s = now_s - self.given_s - reported.load_s - reported.execute_s
        return Timings(
            queued_s=self.given_s - self.record.submitted_s,
            load_s=reported.load_s,
            execute_s=reported.execute_s,
            # The worker's clock may run faster.
            lease_s=max(0.0, lease_s),
        )


@dataclass(slots=True, eq=False)
class GroupRecord:
    """A group, or all rollouts of a batch."""

    size: int = 0
    coming: int = 0
    """Rollouts of a large batch that have no record yet."""
    open: dict[str, RolloutRecord] = field(default_factory=dict)
    """Records of rollouts without an outcome, by id."""
    waiting: int = 0
    """Number of rollouts that ``open`` stands for."""
    failed: bool = False
    """An infrastructure failure took a member."""

    @property
    def left(self) -> int:
        """Number of rollouts without an outcome."""
        return self.waiting + self.coming

    @property
    def in_tail(self) -> bool:
        """True once three quarters are done, until all are."""
        return 0 < 4 * self.left <= self.size


@dataclass(slots=True, eq=False)
class BatchRecord:
    """An open batch."""

    run_id: str
    batch_id: str
    scenes: frozenset[str]
    whole: GroupRecord = field(default_factory=GroupRecord)
    groups: dict[str, GroupRecord] = field(default_factory=dict)
    cursor: int = 0
    """Cursor of the last outcome."""
    rest: Iterator[RolloutRecord] = field(default_factory=lambda: iter(()))
    """Makes the records of the rollouts that are still coming, in order."""

    @property
    def open(self) -> dict[str, RolloutRecord]:
        return self.whole.open

    @property
    def open_scenes(self) -> frozenset[str]:
        """Scenes of rollouts without an outcome; all scenes while some rollouts are still coming."""
        return self.scenes if self.whole.coming else frozenset(record.scene for record in self.open.values())


@dataclass(slots=True)
class RunCounters:
    """Counters of one run."""

    delivered: int = 0
    infra_failures: int = 0
    redispatched: int = 0
    stale_results: int = 0
    warm_starts: int = 0
    cold_starts: int = 0
    hedged: int = 0
    groups_failed: int = 0
    audited: int = 0
    audit_mismatches: int = 0
    steps: int = 0
    shared_steps: int = 0

    def stats(self) -> RunStats:
        return RunStats(**{name: getattr(self, name) for name in self.__slots__})
