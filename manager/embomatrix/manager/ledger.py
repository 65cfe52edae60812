"""What the Task-Dispatcher remembers: rollouts, leases, workers, and who waits for which scene."""

from __future__ import annotations

import heapq
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import TYPE_CHECKING, NamedTuple

from embomatrix.rpc.values import RunStats, Timings

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.rpc.values import LeaseRef, Rollout


class RolloutKey(NamedTuple):
    """Names a rollout in the whole cluster."""

    run_id: str
    batch_id: str
    rollout_id: str


class Phase(Enum):
    """Where a rollout stands: in the queue, taken out of it, or at its one outcome, which is final."""

    PENDING = auto()
    LEASED = auto()
    DONE = auto()


@dataclass(slots=True, eq=False)
class RolloutRecord:
    """A rollout on its way to its outcome. ``sequence`` is its place in the queue, kept when it is given back."""

    key: RolloutKey
    rollout: Rollout
    sequence: int
    submitted_s: float
    warm: bool
    """Its scene was warm somewhere when it was submitted."""
    phase: Phase = Phase.LEASED
    attempts: int = 0
    """Leases that were started and did not deliver."""
    lease: LeaseRecord | None = None

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
    """Leases it may hold: one per slot and one waiting behind each, so that a freed slot never waits for the network."""
    warm: frozenset[str] = frozenset()
    held: dict[str, LeaseRecord] = field(default_factory=dict)
    reported: bool = False
    suspect: bool = False
    draining: bool = False
    completed: int = 0

    @property
    def usable(self) -> bool:
        return self.reported and not self.suspect and not self.draining

    @property
    def open_credits(self) -> int:
        return self.credits - len(self.held) if self.usable else 0

    @property
    def free_slots(self) -> int:
        return self.slots - len(self.held) if self.usable else 0

    @property
    def busyness(self) -> float:
        return len(self.held) / self.slots

    def started(self) -> list[LeaseRecord]:
        """The leases that run: the first ones, one per slot. The others wait behind them and cost no attempt."""
        return list(self.held.values())[: self.slots]


@dataclass(slots=True, eq=False)
class BatchRecord:
    """An open batch: its rollouts without an outcome, and the last cursor that was given."""

    run_id: str
    batch_id: str
    open: dict[str, RolloutRecord]
    cursor: int = 0


@dataclass(slots=True)
class RunCounters:
    """Counters of one run; ``stats`` freezes them."""

    delivered: int = 0
    infra_failures: int = 0
    redispatched: int = 0
    stale_results: int = 0
    warm_starts: int = 0
    cold_starts: int = 0

    def stats(self) -> RunStats:
        return RunStats(
            delivered=self.delivered,
            infra_failures=self.infra_failures,
            redispatched=self.redispatched,
            stale_results=self.stale_results,
            warm_starts=self.warm_starts,
            cold_starts=self.cold_starts,
        )


class PendingQueues:
    """Waiting rollouts by scene, each a heap by sequence. Records that left ``PENDING`` are skipped when they surface."""

    def __init__(self) -> None:
        self._heaps: dict[str, list[tuple[int, RolloutRecord]]] = {}
        self._counts: Counter[str] = Counter()
        self._total = 0

    def __len__(self) -> int:
        return self._total

    def __iter__(self) -> Iterator[RolloutRecord]:
        """Every waiting rollout, in no order."""
        for heap in self._heaps.values():
            yield from {record.key: record for _, record in heap if record.phase is Phase.PENDING}.values()

    @property
    def scenes(self) -> int:
        """How many scenes somebody waits for."""
        return len(self._counts)

    def counts(self) -> dict[str, int]:
        return dict(self._counts)

    def count(self, scene: str) -> int:
        return self._counts[scene]

    def push(self, record: RolloutRecord) -> None:
        """Queue a rollout that no one holds."""
        record.phase = Phase.PENDING
        heapq.heappush(self._heaps.setdefault(record.scene, []), (record.sequence, record))
        self._counts[record.scene] += 1
        self._total += 1

    def remove(self, record: RolloutRecord) -> None:
        """Forget a waiting record; its caller moves it out of ``PENDING``."""
        self._uncount(record.scene)

    def head(self, scene: str) -> RolloutRecord | None:
        """The first in line for the scene."""
        heap = self._heaps.get(scene)
        while heap and heap[0][1].phase is not Phase.PENDING:
            heapq.heappop(heap)
        return heap[0][1] if heap else None

    def pop(self, scene: str) -> RolloutRecord:
        """Take the first in line. KeyError when nobody waits for the scene."""
        record = self.head(scene)
        if record is None:
            raise KeyError(scene)
        heapq.heappop(self._heaps[scene])
        self._uncount(scene)
        record.phase = Phase.LEASED
        return record

    def first_of(self, scenes: frozenset[str]) -> str | None:
        """The scene among these whose first in line is the oldest."""
        few, many = (scenes, self._counts) if len(scenes) < len(self._counts) else (self._counts, scenes)
        heads = [head for scene in few if scene in many and (head := self.head(scene)) is not None]
        return min(heads, key=lambda head: head.sequence).scene if heads else None

    def _uncount(self, scene: str) -> None:
        self._counts[scene] -= 1
        self._total -= 1
        if self._counts[scene] <= 0:
            # What is left in the heap are records that reached their outcome while they waited.
            del self._counts[scene]
            self._heaps.pop(scene, None)
