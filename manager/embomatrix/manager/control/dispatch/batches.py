"""Open batches with their groups, deadlines and result cursors."""

import heapq
import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from embomatrix.manager.control.dispatch.records import (
    BatchRecord,
    DispatchPhase,
    GroupRecord,
    RolloutKey,
    RolloutRecord,
)
from embomatrix.manager.store.protocol import ResultRow
from embomatrix.reward.settings import RewardSettings
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    GroupDone,
    GroupPolicy,
    InfraFailure,
    Outcome,
)

FINISHED_KEPT: Final = 64
"""Finished batches that may wait for their deadline."""


class OpenBatches:
    """Batches that have rollouts without an outcome, by run and batch id."""

    def __init__(self) -> None:
        self.tails: dict[GroupRecord, None] = {}
        """Groups and batches of which at least three quarters are done."""
        self._batches: dict[tuple[str, str], BatchRecord] = {}
        self._sequence = 0
        """Last queue position given out."""
        self._order = itertools.count()
        self._due: list[tuple[float, int, float, BatchRecord]] = []

    def __contains__(self, key: tuple[str, str]) -> bool:
        return key in self._batches

    def __iter__(self) -> Iterator[BatchRecord]:
        return iter(self._batches.values())

    def get(self, key: tuple[str, str]) -> BatchRecord | None:
        return self._batches.get(key)

    def of(self, record: RolloutRecord) -> BatchRecord:
        """Return the open batch of a rollout without an outcome."""
        return self._batches[record.key[:2]]

    @property
    def coming(self) -> int:
        """Number of rollouts of open batches that have no record yet."""
        return sum(batch.whole.coming for batch in self._batches.values())

    def of_run(self, run_id: str) -> list[BatchRecord]:
        return [batch for key, batch in self._batches.items() if key[0] == run_id]

    def open(
        self,
        batch: Batch,
        delivered: Mapping[str, int],
        *,
        now_s: float,
        due_s: float,
        warm: Mapping[str, bool],
        reward: RewardSettings,
    ) -> BatchRecord:
        """Add a batch without the rollouts that were ``delivered`` before, by cursor. ``warm`` covers all its scenes."""
        key = (batch.run_id, batch.batch_id)
        opened = BatchRecord(*key, frozenset(warm), cursor=max(delivered.values(), default=0))
        for rollout in batch.rollouts:
            group = opened.groups.get(rollout.group_id)
            if group is None:
                group = opened.groups[rollout.group_id] = GroupRecord()
            group.size += rollout.count
            group.coming += rollout.count * (rollout.rollout_id not in delivered)
        opened.whole.size = batch.count
        opened.whole.coming = sum(group.coming for group in opened.groups.values())
        opened.rest = _records(batch, delivered, self._sequence, now_s, warm, reward)
        self._sequence += len(batch.rollouts)
        self._batches[key] = opened
        heapq.heappush(self._due, (due_s, next(self._order), now_s, opened))
        return opened

    def admit(self, batch: BatchRecord, count: int | None = None) -> list[RolloutRecord]:
        """Make the records of the next ``count`` rollouts that are still coming, or of all. They are in no queue yet."""
        records = list(itertools.islice(batch.rest, count))
        for record in records:
            for group in (batch.whole, batch.groups[record.rollout.group_id]):
                group.open[record.key.rollout_id] = record
                group.waiting += record.count
                group.coming -= record.count
        return records

    def conclude(self, record: RolloutRecord) -> int:
        """Mark the rollout as done; return the cursor of its outcome."""
        record.phase = DispatchPhase.DONE
        batch = self.of(record)
        for group in (batch.whole, batch.groups[record.rollout.group_id]):
            del group.open[record.key.rollout_id]
            group.waiting -= record.count
            if group.in_tail:
                self.tails[group] = None
            else:
                self.tails.pop(group, None)
        batch.cursor += 1
        return batch.cursor

    def close(self, batch: BatchRecord) -> None:
        del self._batches[batch.run_id, batch.batch_id]
        if len(self._due) > 2 * len(self._batches) + FINISHED_KEPT:
            # Thousands of batches a second may finish behind one long batch at the head.
            self._due = [entry for entry in self._due if entry[-1].whole.left]
            heapq.heapify(self._due)

    def overdue(self, now_s: float) -> Iterator[tuple[RolloutRecord, float]]:
        """Yield each rollout past its deadline, with the seconds that its batch had."""
        # Finished batches leave at the head, so they do not pile up until their deadline.
        while self._due and (not self._due[0][3].whole.left or self._due[0][0] <= now_s):
            due_s, _, submitted_s, batch = heapq.heappop(self._due)
            self.admit(batch)
            for record in list(batch.open.values()):
                if record.phase is not DispatchPhase.DONE:
                    yield record, due_s - submitted_s


def _records(
    batch: Batch,
    delivered: Mapping[str, int],
    after: int,
    now_s: float,
    warm: Mapping[str, bool],
    reward: RewardSettings,
) -> Iterator[RolloutRecord]:
    """Yield records of the undelivered rollouts, made on demand, with queue positions following ``after``."""
    for sequence, rollout in enumerate(batch.rollouts, start=after + 1):
        if rollout.rollout_id not in delivered:
            yield RolloutRecord(
                key=RolloutKey(batch.run_id, batch.batch_id, rollout.rollout_id),
                rollout=rollout,
                sequence=sequence,
                submitted_s=now_s,
                warm=warm[rollout.bundle_digest],
                reward=reward,
            )


def failed_with(
    policy: GroupPolicy, batch: BatchRecord, group: GroupRecord
) -> tuple[list[GroupRecord], list[RolloutRecord]]:
    """Return the groups that fail when a member of ``group`` is lost, and the rollouts to cancel."""
    match policy:
        case GroupPolicy.PARTIAL:
            return [group], []
        case GroupPolicy.RETRY_THEN_FAIL_GROUP:
            return [group], list(group.open.values())
        case GroupPolicy.FAIL_FAST:
            others = [other for other in batch.groups.values() if other.open and other is not group]
            return [group, *others], list(batch.open.values())


def group_sizes(batch: Batch) -> dict[str, int]:
    """Return the number of rollouts of each group."""
    sizes: Counter[str] = Counter()
    for rollout in batch.rollouts:
        sizes[rollout.group_id] += rollout.count
    return dict(sizes)


class GroupEnds:
    """Finds the result that completes each group of one batch, by counting results in cursor order.

    The end of a group depends on that order alone, so a reader that resumes at any cursor sees each end once.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self._sizes = sizes
        self._counts: dict[str, Counter[type[Outcome]]] = defaultdict(Counter)
        """Outcomes of groups that have begun and not ended, by kind."""
        self._ended: dict[int, GroupDone] = {}
        """Ended groups, by the cursor of their last result."""

    def take(self, cursor: int, group_id: str, outcome: type[Outcome], count: int = 1) -> None:
        """Count the next result in cursor order, which ``count`` rollouts have."""
        counts = self._counts[group_id]
        counts[outcome] += count
        if counts.total() == self._sizes.get(group_id):
            del self._counts[group_id]
            self._ended[cursor] = GroupDone(
                group_id, counts[Completed], counts[InfraFailure], counts[Cancelled]
            )

    def among(self, rows: Iterable[ResultRow]) -> list[GroupDone]:
        """Return the groups that end with one of these results."""
        return [self._ended[row.cursor] for row in rows if row.cursor in self._ended]
