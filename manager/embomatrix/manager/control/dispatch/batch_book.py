"""Open batches: their groups, their tails, what is due, and the cursors that were given."""

from __future__ import annotations

import heapq
import itertools
from typing import TYPE_CHECKING

from embomatrix.manager.control.dispatch.ledger import (
    BatchRecord,
    DispatchPhase,
    GroupRecord,
    RolloutKey,
    RolloutRecord,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from embomatrix.reward.settings import RewardSettings
    from embomatrix.rpc.wire.values import Batch


class BatchBook:
    """Batches that have rollouts without an outcome, by run and id."""

    def __init__(self) -> None:
        self.tails: dict[GroupRecord, None] = {}
        """Groups and batches of which three quarters are done."""
        self._batches: dict[tuple[str, str], BatchRecord] = {}
        self._sequence = 0
        """The last place in the queue that was given."""
        self._order = itertools.count()
        self._due: list[tuple[float, int, float, BatchRecord]] = []

    def __contains__(self, key: tuple[str, str]) -> bool:
        return key in self._batches

    def get(self, key: tuple[str, str]) -> BatchRecord | None:
        return self._batches.get(key)

    def of(self, record: RolloutRecord) -> BatchRecord:
        """The open batch of a rollout without an outcome."""
        return self._batches[record.key[:2]]

    @property
    def coming(self) -> int:
        """Rollouts of open batches that have no record yet."""
        return sum(batch.whole.coming for batch in self._batches.values())

    def scenes(self) -> frozenset[str]:
        """Of rollouts without an outcome."""
        return frozenset().union(*(batch.open_scenes for batch in self._batches.values()))

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
        """Note a batch, of which those come that were not delivered before. ``warm`` tells it of each of its scenes."""
        key = (batch.run_id, batch.batch_id)
        noted = BatchRecord(*key, frozenset(warm), cursor=max(delivered.values(), default=0))
        for rollout in batch.rollouts:
            group = noted.groups.get(rollout.group_id)
            if group is None:
                group = noted.groups[rollout.group_id] = GroupRecord()
            group.size += 1
            group.coming += rollout.rollout_id not in delivered
        noted.whole.size = len(batch.rollouts)
        noted.whole.coming = sum(group.coming for group in noted.groups.values())
        noted.rest = _records(batch, delivered, self._sequence, now_s, warm, reward)
        self._sequence += len(batch.rollouts)
        self._batches[key] = noted
        heapq.heappush(self._due, (due_s, next(self._order), now_s, noted))
        return noted

    def admit(self, batch: BatchRecord, count: int | None = None) -> list[RolloutRecord]:
        """The next so many of those that are coming, or all: nobody holds them, and they are in no queue."""
        records = list(itertools.islice(batch.rest, count))
        for record in records:
            for group in (batch.whole, batch.groups[record.rollout.group_id]):
                group.open[record.key.rollout_id] = record
                group.coming -= 1
        return records

    def conclude(self, record: RolloutRecord) -> int:
        """The rollout has its outcome; returns the cursor of it."""
        record.phase = DispatchPhase.DONE
        batch = self.of(record)
        for group in (batch.whole, batch.groups[record.rollout.group_id]):
            del group.open[record.key.rollout_id]
            if group.in_tail:
                self.tails[group] = None
            else:
                self.tails.pop(group, None)
        batch.cursor += 1
        return batch.cursor

    def close(self, batch: BatchRecord) -> None:
        del self._batches[batch.run_id, batch.batch_id]

    def overdue(self, now_s: float) -> Iterator[tuple[RolloutRecord, float]]:
        """Rollouts whose deadline has passed without an outcome, and the time that they had: that of their batch."""
        # Deadlines come in order of submission: what is done leaves at the head and doesn't pile up until its deadline.
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
    """Records of what was not delivered before, each made when it is asked for. Their places in the queue follow ``after``."""
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
