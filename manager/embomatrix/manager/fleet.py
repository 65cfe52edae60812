"""The workers as the Task-Dispatcher sees them: what they hold warm, and how much more they can take."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Final

from embomatrix.manager.ledger import LeaseRecord, WorkerRecord

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

VICTIMS: Final = 32
"""Busy workers looked at before stealing is given up: a bound, so that a large cluster costs no more than a small one."""


class Fleet:
    """Live workers by id, with indices by warm scene and by backlog."""

    def __init__(self) -> None:
        self.workers: dict[str, WorkerRecord] = {}
        self._warm_on: dict[str, set[str]] = {}
        self._backlogged: dict[str, None] = {}

    def join(self, worker_id: str, slots: int) -> None:
        """A new worker, which can take nothing until it has reported."""
        slots = max(slots, 1)
        self.workers[worker_id] = WorkerRecord(worker_id, slots=slots, credits=2 * slots)

    def leave(self, worker_id: str) -> WorkerRecord | None:
        worker = self.workers.get(worker_id)
        if worker is not None:
            self.set_warm(worker, ())
            self._backlogged.pop(worker_id, None)
            del self.workers[worker_id]
        return worker

    def set_warm(self, worker: WorkerRecord, scenes: Iterable[str]) -> None:
        """Replace the scenes that the worker holds warm."""
        warm = frozenset(scenes)
        for scene in worker.warm - warm:
            self._warm_on[scene].discard(worker.worker_id)
            if not self._warm_on[scene]:
                del self._warm_on[scene]
        for scene in warm - worker.warm:
            self._warm_on.setdefault(scene, set()).add(worker.worker_id)
        worker.warm = warm

    def has_warm(self, scene: str) -> bool:
        return scene in self._warm_on

    def hold(self, worker: WorkerRecord, lease: LeaseRecord) -> None:
        worker.held[lease.ref.lease_id] = lease
        if len(worker.held) > worker.slots:
            self._backlogged[worker.worker_id] = None

    def release(self, lease: LeaseRecord) -> None:
        worker = self.workers.get(lease.worker_id)
        if worker is not None:
            worker.held.pop(lease.ref.lease_id, None)
            if len(worker.held) <= worker.slots:
                self._backlogged.pop(worker.worker_id, None)

    def best_for(self, scene: str) -> WorkerRecord | None:
        """The least busy worker with the scene warm and a free credit; the id breaks ties."""
        holders = (self.workers[worker_id] for worker_id in self._warm_on.get(scene, ()))
        free = [worker for worker in holders if worker.open_credits > 0]
        return min(free, key=lambda worker: (worker.busyness, worker.worker_id), default=None)

    def waiting_behind(self, thief: WorkerRecord, before_s: float) -> LeaseRecord | None:
        """A lease, given before that time, that waits behind a busy slot and whose scene the thief holds warm."""
        for worker_id in islice(self._backlogged, VICTIMS):
            lease = next(reversed(self.workers[worker_id].held.values()))
            if (
                worker_id != thief.worker_id
                and lease.record.scene in thief.warm
                and lease.given_s <= before_s
            ):
                return lease
        return None

    def idle(self) -> Iterator[WorkerRecord]:
        """Workers with a free slot."""
        return (worker for worker in self.workers.values() if worker.free_slots > 0)

    @property
    def live(self) -> int:
        """Workers that could take work now or soon: neither draining nor suspected."""
        return sum(not (worker.draining or worker.suspect) for worker in self.workers.values())
