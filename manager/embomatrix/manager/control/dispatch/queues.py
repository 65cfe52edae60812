"""Queues of waiting rollouts. Runs share slot time by weight; within a run the first submitted goes first."""

from __future__ import annotations

import heapq
import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator

from embomatrix.manager.control.dispatch.records import DispatchPhase, FairShareTurn, QueueKey, RolloutRecord
from embomatrix.manager.control.workers import WorkerRecord

_Heap = list[tuple[int, int, RolloutRecord]]
"""Entries of sequence, number and record. The number is unique: two checks of one rollout have the same sequence."""


class PendingQueues:
    """Waiting rollouts: by scene, and by queue key, a heap by sequence."""

    def __init__(self, turn: Callable[[RolloutRecord], FairShareTurn]) -> None:
        self._turn = turn
        self._heaps: dict[str, dict[QueueKey, _Heap]] = {}
        """Entries whose record is not PENDING are stale and skipped at the head."""
        self._counts: Counter[str] = Counter()
        """Waiting records by scene; no zero entries."""
        self._by_run: Counter[str] = Counter()
        """Waiting rollouts by run; no zero entries."""
        self._numbers = itertools.count()

    def __len__(self) -> int:
        """Number of waiting rollouts."""
        return sum(self._by_run.values())

    def __iter__(self) -> Iterator[RolloutRecord]:
        """Yield every waiting rollout, in no order."""
        for queues in self._heaps.values():
            for heap in queues.values():
                yield from (record for *_, record in heap if record.phase is DispatchPhase.PENDING)

    @property
    def scene_count(self) -> int:
        """Number of scenes with waiting rollouts."""
        return len(self._counts)

    def counts(self) -> dict[str, int]:
        return dict(self._counts)

    def count(self, scene: str) -> int:
        return self._counts[scene]

    def of_run(self, run_id: str) -> int:
        return self._by_run[run_id]

    def push(self, record: RolloutRecord) -> None:
        record.phase = DispatchPhase.PENDING
        heap = self._heaps.setdefault(record.scene, {}).setdefault(record.queue, [])
        heapq.heappush(heap, (record.sequence, next(self._numbers), record))
        self._counts[record.scene] += 1
        self._by_run[record.key.run_id] += record.count

    def heads(self, scene: str) -> list[RolloutRecord]:
        """Return the first rollout of each queue of the scene, in order of turns."""
        queues = self._heaps.get(scene, {})
        heads = [head for heap in queues.values() if (head := _head(heap)) is not None]
        return sorted(heads, key=self._turn) if len(heads) > 1 else heads

    def oldest(self, scene: str) -> RolloutRecord | None:
        """Return the rollout of the scene that was submitted first, of whatever run."""
        return min(self.heads(scene), key=lambda record: record.sequence, default=None)

    def choice(self, worker: WorkerRecord, now_s: float) -> Choice:
        """Return the waiting rollouts of the worker's warm scenes, in order of turns."""
        few: Iterable[str]
        few, many = (
            (worker.warm, self._heaps) if len(worker.warm) < len(self._heaps) else (self._heaps, worker.warm)
        )
        queues = (queue for scene in few if scene in many for queue in self._heaps[scene].items())
        return Choice(queues, self._turn, worker, now_s)

    def take(self, record: RolloutRecord) -> None:
        """Move a waiting record out of its queue: it is leased next."""
        heap = self._heaps[record.scene][record.queue]
        if heap[0][-1] is record:
            heapq.heappop(heap)
        else:
            del heap[next(index for index, entry in enumerate(heap) if entry[-1] is record)]
            heapq.heapify(heap)
        self.uncount(record)
        record.phase = DispatchPhase.LEASED

    def uncount(self, record: RolloutRecord) -> None:
        """Count a waiting record no more. The caller changes its phase, which makes its heap entry stale."""
        scene, run_id = record.scene, record.key.run_id
        self._counts[scene] -= 1
        self._by_run[run_id] -= record.count
        if not self._by_run[run_id]:
            del self._by_run[run_id]
        if not self._counts[scene]:
            # Only stale entries are left in the heaps.
            del self._counts[scene]
            self._heaps.pop(scene, None)

    def check_invariants(self) -> None:
        """Raise AssertionError if a count disagrees with the queues."""
        waiting = set(self)
        assert Counter(record.scene for record in waiting) == self._counts
        by_run: Counter[str] = Counter()
        for record in waiting:
            by_run[record.key.run_id] += record.count
        assert by_run == self._by_run
        assert not any(record.leases or record.held for record in waiting)


class Choice:
    """Rollouts for one worker, in order of turns. Valid as long as each is taken before the next is asked for."""

    def __init__(
        self,
        queues: Iterable[tuple[QueueKey, _Heap]],
        turn: Callable[[RolloutRecord], FairShareTurn],
        worker: WorkerRecord,
        now_s: float,
    ) -> None:
        self._turn = turn
        self._worker = worker
        self._now_s = now_s
        by_run: dict[str, list[tuple[int, int, _Heap]]] = {}
        for number, (key, heap) in enumerate(queues):
            if heap:
                by_run.setdefault(key.run_id, []).append((heap[0][0], number, heap))
        self._runs = list(by_run.values())
        """One heap per run with its queues, by a lower bound of the sequence that the worker may take."""
        for run in self._runs:
            heapq.heapify(run)

    def next(self) -> RolloutRecord | None:
        """Return the rollout whose turn it is; None if the worker may take none."""
        best: RolloutRecord | None = None
        least: FairShareTurn | None = None
        for run in self._runs:
            record = self._first_of(run)
            # Sequence decides within a run, turns decide between runs.
            if record is not None and (least is None or self._turn(record) < least):
                best, least = record, self._turn(record)
        return best

    def _first_of(self, run: list[tuple[int, int, _Heap]]) -> RolloutRecord | None:
        while run:
            bound, number, heap = run[0]
            record = _first_taken(heap, self._worker, self._now_s)
            if record is None:
                heapq.heappop(run)
            elif record.sequence == bound:
                return record
            else:
                heapq.heapreplace(run, (record.sequence, number, heap))
        return None


def _head(heap: _Heap) -> RolloutRecord | None:
    while heap and heap[0][-1].phase is not DispatchPhase.PENDING:
        heapq.heappop(heap)
    return heap[0][-1] if heap else None


def _first_taken(heap: _Heap, worker: WorkerRecord, now_s: float) -> RolloutRecord | None:
    """Return the first rollout of the queue that the worker may take.

    Only rollouts that recently failed on this worker are skipped; any other refusal holds for the whole queue. The heap
    is walked best first, so skipping k rollouts costs O(k log k).
    """
    head = _head(heap)
    if head is None or worker.takes(head, now_s):
        return head
    frontier = [(heap[0][0], 0)]
    while frontier:
        _, index = heapq.heappop(frontier)
        record = heap[index][-1]
        if record.phase is DispatchPhase.PENDING:
            if worker.takes(record, now_s):
                return record
            if not worker.avoids(record, now_s):
                return None
        for child in (2 * index + 1, 2 * index + 2):
            if child < len(heap):
                heapq.heappush(frontier, (heap[child][0], child))
    return None
