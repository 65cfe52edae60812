"""What the Task-Dispatcher remembers: rollouts and their groups, leases, workers and runs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum, auto
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.values import RunStats, Timings

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from embomatrix.rpc.wire.leases import LeaseRef
    from embomatrix.rpc.wire.values import Rollout


AHEAD_S: Final = 0.2
"""A worker holds leases for this long ahead: its slots go on while results and new leases travel many to a message."""
BEHIND: Final = 64
"""Leases that wait behind a slot at most, however fast it is."""
PACE_WEIGHT: Final = 0.1
"""Of the latest rollout in what a worker is taken to need for one."""
BEGINS_S: Final = 0.1
LATE_S: Final = 0.2
"""What waits behind a slot is left to it from so long before its pace has it begin until so long after: the slot's process
has it by then, and what has ended lies in streams for a while before the manager hears of it."""

LAG_WEIGHT: Final = 0.2
"""Weight of the latest of a worker's leases, in the mean of the logarithms: one odd lease makes nobody slow."""
LAG_PLAIN: Final = math.log(2.5)
"""Workers that are slower than others by less than this are left alone: their claims and luck explain it."""


class RolloutKey(NamedTuple):
    """Names a rollout in the whole cluster."""

    run_id: str
    batch_id: str
    rollout_id: str


class Lane(NamedTuple):
    """Rollouts of one run that need the same kind of slot and worker."""

    run_id: str
    render: bool
    barred: frozenset[str]


class DispatchPhase(Enum):
    """Where a rollout stands: in the queue, taken out of it, or at its one outcome, which is final."""

    PENDING = auto()
    LEASED = auto()
    DONE = auto()


@dataclass(slots=True, eq=False)
class RolloutRecord:
    """A rollout on its way to its outcome. ``sequence`` is its place in the queue, kept when it is given back.

    It has at most one live lease, or two on different workers once it was hedged.
    """

    key: RolloutKey
    rollout: Rollout
    sequence: int
    submitted_s: float
    warm: bool
    """Its scene was warm somewhere when it was submitted."""
    phase: DispatchPhase = DispatchPhase.LEASED
    attempts: int = 0
    """Leases that were started and did not deliver."""
    leases: list[LeaseRecord] = field(default_factory=list)
    hedged: bool = False
    out_of_memory: bool = False
    """An attempt ended for lack of memory: another one beside it would only need more."""
    failed_on: str = ""
    avoid_until_s: float = -math.inf
    """The worker that it failed on last gets it again only from then on, while there are others."""
    held: bool = False
    """It was executed, and the result waits until another worker has come to the same."""
    check: bool = False
    """It is a further execution of a rollout, to compare: no batch has it."""
    barred: frozenset[str] = frozenset()
    """Workers that executed it before, and whose results it is to be compared with."""
    reward: RewardSettings = PAPER
    """How its run wants it scored."""
    lane: Lane = field(init=False)

    def __post_init__(self) -> None:
        self.lane = Lane(self.key.run_id, self.rollout.render, self.barred)

    @property
    def scene(self) -> str:
        return self.rollout.bundle_digest


@dataclass(slots=True, eq=False)
class LeaseRecord:
    """A live lease. It ends ``expires_s`` unless renewed, and ``limit_s`` whatever the worker says."""

    ref: LeaseRef
    worker_id: str
    record: RolloutRecord
    given_s: float
    expires_s: float
    limit_s: float
    charged_s: float = 0.0
    """What its run was charged in advance: slot time over weight."""
    started_s: float | None = None
    """When a slot became free for it, as the manager reckons: the first leases of a worker run, the others wait behind."""
    steps: int = -1
    moved_s: float = 0.0
    """Steps that it has done, as a heartbeat told last, and when they rose; -1 before a heartbeat told of any."""

    @property
    def due_s(self) -> float:
        return min(self.expires_s, self.limit_s)

    def timings(self, told: Timings, now_s: float) -> Timings:
        """What the worker told of its part, with the manager's own: of a lease that ends now."""
        lease_s = now_s - self.given_s - told.load_s - told.execute_s
        return Timings(
            queued_s=self.given_s - self.record.submitted_s,
            load_s=told.load_s,
            execute_s=told.execute_s,
            # The worker's clock may run faster.
            lease_s=max(0.0, lease_s),
        )


@dataclass(slots=True, eq=False)
class WorkerRecord:
    """A worker as the dispatcher sees it. ``held`` keeps the order in which the leases were given."""

    worker_id: str
    slots: int
    credits: int
    """Leases it may hold: one for each slot, and behind it one that waits, or as many as it executes within ``AHEAD_S``."""
    warm: frozenset[str] = frozenset()
    held: dict[str, LeaseRecord] = field(default_factory=dict)
    reported: bool = False
    suspect: bool = False
    drained: bool = False
    """By an operator."""
    leaving: bool = False
    """It said so itself."""
    paused: str = ""
    """Why it takes nothing new for now, in its own words."""
    quarantined: bool = False
    """It was found to give wrong results."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Of what its results depend on."""
    log_lag: float = 0.0
    reluctance_s: float = 0.0
    """It takes only rollouts that have waited for so long: the time that it needs longer than others."""
    render_slots: int = 0
    rendering: int = 0
    """Leases among ``held`` that need a slot which renders: no more than there are such slots."""
    completed: int = 0
    pace_s: float = 0.0
    """What it needs for one rollout, the latest ones before others."""

    @property
    def draining(self) -> bool:
        return self.drained or self.leaving

    @property
    def usable(self) -> bool:
        return self.reported and not (
            self.suspect or self.drained or self.leaving or self.paused or self.quarantined
        )

    @property
    def free_render_slots(self) -> int:
        return self.render_slots - self.rendering

    @property
    def open_credits(self) -> int:
        most = self.credits if self.lag == 1.0 else self.slots  # nobody shall wait behind a slow slot
        return most - len(self.held) if self.usable else 0

    @property
    def free_slots(self) -> int:
        return self.slots - len(self.held) if self.usable else 0

    @property
    def busyness(self) -> float:
        """Shares of its slots that are taken; whoever lags comes after all others."""
        return len(self.held) / self.slots + self.lag - 1.0

    def note_lag(self, ratio: float) -> None:
        """One of its leases took ``ratio`` times as long as those of its run as a rule."""
        self.log_lag += LAG_WEIGHT * (math.log(max(ratio, 1e-3)) - self.log_lag)

    @property
    def lag(self) -> float:
        """How many times slower it is than others, by its latest leases; 1 unless that is plain."""
        return math.exp(self.log_lag) if self.log_lag >= LAG_PLAIN else 1.0

    def note_completed(self, execute_s: float) -> None:
        """It executed a rollout in so many seconds: how many it may hold follows its pace."""
        weight = PACE_WEIGHT if self.completed else 1.0
        self.completed += 1
        self.pace_s += weight * (execute_s - self.pace_s)
        behind = math.ceil(AHEAD_S / self.pace_s) if self.pace_s * BEHIND > AHEAD_S else BEHIND
        self.credits = self.slots * (1 + behind)

    def begins_soon(self, now_s: float) -> bool:
        """Whether the last of its leases, which waits behind a slot, is about to begin or has just begun, by its pace."""
        running = islice(self.held.values(), self.slots)
        began_s = max(
            (lease.started_s for lease in running if lease.started_s is not None), default=-math.inf
        )
        in_s = began_s + self.pace_s * math.ceil(len(self.held) / self.slots - 1) - now_s
        return self.completed > 0 and -LATE_S < in_s < BEGINS_S

    def avoids(self, record: RolloutRecord, now_s: float) -> bool:
        """True while the rollout's last failure on this worker is too recent."""
        return record.failed_on == self.worker_id and now_s < record.avoid_until_s

    def takes(self, record: RolloutRecord, now_s: float) -> bool:
        """True if this rollout may run here, apart from credits and the scene."""
        if self.avoids(record, now_s):
            return False
        if now_s - record.submitted_s < self.reluctance_s:
            return False
        if record.rollout.render and self.rendering >= self.render_slots:
            return False
        if self.worker_id in record.barred:
            return False
        return not record.leases or all(lease.worker_id != self.worker_id for lease in record.leases)


@dataclass(slots=True, eq=False)
class GroupRecord:
    """A group, or a whole batch as far as its tail goes: ``size`` rollouts, of which ``open`` have no outcome.

    Of a large batch some are still ``coming``: they have neither a record nor an outcome.
    """

    size: int = 0
    coming: int = 0
    open: dict[str, RolloutRecord] = field(default_factory=dict)
    failed: bool = False
    """The infrastructure lost a member."""

    @property
    def left(self) -> int:
        """Rollouts without an outcome."""
        return len(self.open) + self.coming

    @property
    def in_tail(self) -> bool:
        """Three quarters are done, and something is left."""
        return 0 < 4 * self.left <= self.size


@dataclass(slots=True, eq=False)
class BatchRecord:
    """An open batch: its rollouts by group, those without an outcome, and the last cursor that was given."""

    run_id: str
    batch_id: str
    scenes: frozenset[str]
    whole: GroupRecord = field(default_factory=GroupRecord)
    groups: dict[str, GroupRecord] = field(default_factory=dict)
    cursor: int = 0
    rest: Iterator[RolloutRecord] = field(default_factory=lambda: iter(()))
    """Makes the records of those that are still coming, in order."""

    @property
    def open(self) -> dict[str, RolloutRecord]:
        return self.whole.open

    @property
    def open_scenes(self) -> frozenset[str]:
        """Of rollouts without an outcome; while some are coming, of all."""
        return self.scenes if self.whole.coming else frozenset(record.scene for record in self.open.values())


@dataclass(slots=True)
class RunCounters:
    """Counters of one run; ``stats`` freezes them."""

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

    def stats(self) -> RunStats:
        return RunStats(
            delivered=self.delivered,
            infra_failures=self.infra_failures,
            redispatched=self.redispatched,
            stale_results=self.stale_results,
            warm_starts=self.warm_starts,
            cold_starts=self.cold_starts,
            hedged=self.hedged,
            groups_failed=self.groups_failed,
            audited=self.audited,
            audit_mismatches=self.audit_mismatches,
        )
