"""Open batches: their groups, their tails, what is due, and the cursors that were given."""

from __future__ import annotations

import heapq
import itertools
from typing import TYPE_CHECKING

from embomatrix.manager.ledger import BatchRecord, GroupRecord, Phase, RolloutKey, RolloutRecord

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from embomatrix.reward.settings import RewardSettings
    from embomatrix.rpc.values import Batch


class BatchBook:
    """Batches that have rollouts without an outcome, by run and id."""

    def __init__(self) -> None:
        self.tails: dict[GroupRecord, None] = {}
        """Groups and batches of which three quarters are done."""
        self._batches: dict[tuple[str, str], BatchRecord] = {}
        self._sequences = itertools.count(1)
        self._due: list[tuple[float, int, RolloutRecord]] = []

    def __contains__(self, key: tuple[str, str]) -> bool:
        return key in self._batches

    def get(self, key: tuple[str, str]) -> BatchRecord | None:
        return self._batches.get(key)

    def of(self, record: RolloutRecord) -> BatchRecord:
        """The open batch of a rollout without an outcome."""
        return self._batches[record.key[:2]]

    def scenes(self) -> frozenset[str]:
        """Of rollouts without an outcome."""
        return frozenset(record.scene for batch in self._batches.values() for record in batch.open.values())

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
        """Note a batch; its open rollouts are those that were not delivered before. ``warm`` tells it of each scene."""
        key = (batch.run_id, batch.batch_id)
        noted = BatchRecord(*key, GroupRecord(len(batch.rollouts)), cursor=max(delivered.values(), default=0))
        self._batches[key] = noted
        for rollout in batch.rollouts:
            group = noted.groups.get(rollout.group_id)
            if group is None:
                group = noted.groups[rollout.group_id] = GroupRecord(0)
            group.size += 1
            if rollout.rollout_id in delivered:
                continue
            record = RolloutRecord(
                key=RolloutKey(*key, rollout.rollout_id),
                rollout=rollout,
                sequence=next(self._sequences),
                submitted_s=now_s,
                warm=warm[rollout.bundle_digest],
                reward=reward,
            )
            noted.open[rollout.rollout_id] = group.open[rollout.rollout_id] = record
            heapq.heappush(self._due, (due_s, record.sequence, record))
        return noted

    def conclude(self, record: RolloutRecord) -> int:
        """The rollout has its outcome; returns the cursor of it."""
        record.phase = Phase.DONE
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
        """Rollouts whose deadline has passed without an outcome, and the time that they had."""
        # Deadlines come in order of submission: what is done leaves at the head and doesn't pile up until its deadline.
        while self._due and (self._due[0][2].phase is Phase.DONE or self._due[0][0] <= now_s):
            due_s, _, record = heapq.heappop(self._due)
            if record.phase is not Phase.DONE:
                yield record, due_s - record.submitted_s
