"""Waiting rollouts by scene and lane, and whose turn it is: runs share the slots' time by weight, not by counts."""

from __future__ import annotations

import heapq
from collections import Counter
from typing import TYPE_CHECKING

from embomatrix.manager.control.dispatch.ledger import DispatchPhase, RolloutRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from embomatrix.manager.control.dispatch.ledger import Lane, WorkerRecord

Turn = tuple[float, float, int]
"""Orders waiting rollouts: whose is least goes first."""


_Heap = list[tuple[int, RolloutRecord]]


class PendingQueues:
    """By scene, a heap by sequence for each lane. Records that left ``PENDING`` are skipped when they surface."""

    def __init__(self, turn: Callable[[RolloutRecord], Turn]) -> None:
        self._turn = turn
        self._heaps: dict[str, dict[Lane, _Heap]] = {}
        self._counts: Counter[str] = Counter()
        self._by_run: Counter[str] = Counter()

    def __len__(self) -> int:
        return sum(self._by_run.values())

    def __iter__(self) -> Iterator[RolloutRecord]:
        """Every waiting rollout, in no order."""
        for lanes in self._heaps.values():
            for heap in lanes.values():
                yield from (record for _, record in heap if record.phase is DispatchPhase.PENDING)

    @property
    def scenes(self) -> int:
        """How many scenes somebody waits for."""
        return len(self._counts)

    def counts(self) -> dict[str, int]:
        return dict(self._counts)

    def count(self, scene: str) -> int:
        return self._counts[scene]

    def of_run(self, run_id: str) -> int:
        return self._by_run[run_id]

    def push(self, record: RolloutRecord) -> None:
        """Queue a rollout that no one holds."""
        record.phase = DispatchPhase.PENDING
        heap = self._heaps.setdefault(record.scene, {}).setdefault(record.lane, [])
        heapq.heappush(heap, (record.sequence, record))
        self._counts[record.scene] += 1
        self._by_run[record.key.run_id] += 1

    def remove(self, record: RolloutRecord) -> None:
        """Forget a waiting record; its caller moves it to its outcome."""
        self._uncount(record)

    def heads(self, scene: str) -> list[RolloutRecord]:
        """The first of each lane of the scene, whose turn it is first."""
        lanes = self._heaps.get(scene, {})
        heads = [head for heap in lanes.values() if (head := _head(heap)) is not None]
        return sorted(heads, key=self._turn) if len(heads) > 1 else heads

    def oldest(self, scene: str) -> RolloutRecord | None:
        """The one that was submitted first, whosever turn it is."""
        return min(self.heads(scene), key=lambda record: record.sequence, default=None)

    def choice(self, worker: WorkerRecord, now_s: float) -> Choice:
        """What the worker should take next, and after that, of the scenes that it holds warm."""
        few: Iterable[str]
        few, many = (
            (worker.warm, self._heaps) if len(worker.warm) < len(self._heaps) else (self._heaps, worker.warm)
        )
        lanes = (lane for scene in few if scene in many for lane in self._heaps[scene].items())
        return Choice(lanes, self._turn, worker, now_s)

    def take(self, record: RolloutRecord) -> None:
        """The record gets a lease."""
        heap = self._heaps[record.scene][record.lane]
        if heap[0][1] is record:
            heapq.heappop(heap)
        else:
            heap.remove((record.sequence, record))
            heapq.heapify(heap)
        self._uncount(record)
        record.phase = DispatchPhase.LEASED

    def _uncount(self, record: RolloutRecord) -> None:
        scene, run_id = record.scene, record.key.run_id
        self._counts[scene] -= 1
        self._by_run[run_id] -= 1
        if not self._by_run[run_id]:
            del self._by_run[run_id]
        if not self._counts[scene]:
            # What is left in the heaps are records that reached their outcome while they waited.
            del self._counts[scene]
            self._heaps.pop(scene, None)


class Choice:
    """Rollouts for one worker, by turns. Valid while each is taken as it is told, and nothing else comes or goes."""

    def __init__(
        self,
        lanes: Iterable[tuple[Lane, _Heap]],
        turn: Callable[[RolloutRecord], Turn],
        worker: WorkerRecord,
        now_s: float,
    ) -> None:
        self._turn = turn
        self._worker = worker
        self._now_s = now_s
        by_run: dict[str, list[tuple[int, int, _Heap]]] = {}
        for number, (lane, heap) in enumerate(lanes):
            if heap:
                by_run.setdefault(lane.run_id, []).append((heap[0][0], number, heap))
        self._runs = list(by_run.values())
        """Of each run a heap of its lanes, by the least place that what the worker takes of the lane may have."""
        for run in self._runs:
            heapq.heapify(run)

    def next(self) -> RolloutRecord | None:
        """Whose turn it is; None when there is nothing that the worker may take."""
        best: RolloutRecord | None = None
        least: Turn | None = None
        for run in self._runs:
            record = self._first_of(run)
            # Within a run whoever was first goes first; between runs their turns decide.
            if record is not None and (least is None or self._turn(record) < least):
                best, least = record, self._turn(record)
        return best

    def _first_of(self, run: list[tuple[int, int, _Heap]]) -> RolloutRecord | None:
        while run:
            place, number, heap = run[0]
            record = _first_taken(heap, self._worker, self._now_s)
            if record is None:
                heapq.heappop(run)
            elif record.sequence == place:
                return record
            else:
                heapq.heapreplace(run, (record.sequence, number, heap))
        return None


def _head(heap: _Heap) -> RolloutRecord | None:
    while heap and heap[0][1].phase is not DispatchPhase.PENDING:
        heapq.heappop(heap)
    return heap[0][1] if heap else None


def _first_taken(heap: _Heap, worker: WorkerRecord, now_s: float) -> RolloutRecord | None:
    """Return the first rollout of the queue that the worker may take, however many it may not take come before it.

    Only rollouts that failed on this worker a moment ago are skipped; any other refusal holds for the whole queue. The
    heap is walked best first, so skipping k rollouts costs O(k log k).
    """
    if _head(heap) is None:
        return None
    frontier = [(heap[0][0], 0)]
    while frontier:
        _, index = heapq.heappop(frontier)
        record = heap[index][1]
        if record.phase is DispatchPhase.PENDING:
            if worker.takes(record, now_s):
                return record
            if not worker.avoids(record, now_s):
                return None
        for child in (2 * index + 1, 2 * index + 2):
            if child < len(heap):
                heapq.heappush(frontier, (heap[child][0], child))
    return None
