"""Live leases: given under an epoch that is never used again, renewed by heartbeats, due when silent or too old."""

from __future__ import annotations

import heapq
import itertools
from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.dispatch.ledger import DispatchPhase, LeaseRecord, RolloutRecord, WorkerRecord
from embomatrix.rpc.wire.leases import LeaseRef

if TYPE_CHECKING:
    from collections.abc import Iterable

    from embomatrix.manager.control.dispatch.fleet import Fleet
    from embomatrix.manager.control.dispatch.run_book import RunBook
    from embomatrix.rpc.wire.leases import LeaseProgress

STALE_MEMORY: Final = 65_536
"""Ended leases of which the book still knows the run, to count a late result where it belongs."""


class LeaseBook:
    """``boot_id`` makes the lease ids of this manager's process unlike those of any other.


    Epochs rise from ``first_epoch``: what lies below was given by a former manager.
    """

    def __init__(
        self,
        fleet: Fleet,
        runs: RunBook,
        *,
        boot_id: str,
        ttl_s: float,
        limit_s: float,
        first_epoch: int = 1,
    ) -> None:
        self.live: dict[str, LeaseRecord] = {}
        self.expired = 0
        """Leases whose time was up, so far."""
        self.in_use: Counter[tuple[str, str]] = Counter()
        """Live leases by (worker, scene)."""
        self._used: set[tuple[str, str]] = set()
        self._fleet = fleet
        self._runs = runs
        self._boot_id = boot_id
        self._ttl_s = ttl_s
        self._limit_s = limit_s
        self._first_epoch = first_epoch
        self._epochs = itertools.count(first_epoch)
        self._due: list[tuple[float, int, LeaseRecord]] = []
        self._ended: OrderedDict[str, str] = OrderedDict()

    def give(self, record: RolloutRecord, worker: WorkerRecord, now_s: float) -> LeaseRecord:
        """Lease the rollout to the worker: one that no one holds, or one that is to run twice at once."""
        epoch = next(self._epochs)
        return self.note(LeaseRef(f"{self._boot_id}-{epoch}", epoch), record, worker, now_s)

    def note(self, ref: LeaseRef, record: RolloutRecord, worker: WorkerRecord, now_s: float) -> LeaseRecord:
        """Enter a lease that the worker holds from now on, or held under a former manager."""
        lease = LeaseRecord(
            ref=ref,
            worker_id=worker.worker_id,
            record=record,
            given_s=now_s,
            expires_s=now_s + self._ttl_s,
            limit_s=now_s + self._limit_s,
        )
        record.phase = DispatchPhase.LEASED
        record.leases.append(lease)
        self._runs.charge(lease)
        self.live[lease.ref.lease_id] = lease
        self._fleet.hold(worker, lease)
        heapq.heappush(self._due, (lease.due_s, ref.lease_epoch, lease))
        self._used.add((worker.worker_id, record.scene))
        self.in_use[worker.worker_id, record.scene] += 1
        return lease

    def is_former(self, ref: LeaseRef) -> bool:
        """Whether a former manager gave it."""
        return ref.lease_epoch < self._first_epoch

    def disown(self, ref: LeaseRef, run_id: str) -> None:
        """A lease that is not taken up: a result of it is stale."""
        self._ended[ref.lease_id] = run_id
        self._forget_ended()

    def end(self, lease: LeaseRecord, now_s: float) -> None:
        """The lease is over, whatever its worker still does. What becomes of the rollout, its caller decides."""
        lease.record.leases.remove(lease)
        del self.live[lease.ref.lease_id]
        self._fleet.release(lease, now_s)
        self._runs.settle(lease, now_s)
        pair = (lease.worker_id, lease.record.scene)
        self.in_use[pair] -= 1
        if not self.in_use[pair]:
            del self.in_use[pair]
        self._ended[lease.ref.lease_id] = lease.record.key.run_id
        self._forget_ended()

    def _forget_ended(self) -> None:
        while len(self._ended) > STALE_MEMORY:
            self._ended.popitem(last=False)

    def find(self, worker_id: str, ref: LeaseRef) -> LeaseRecord | None:
        """The live lease of that name, epoch and worker; None for a stale one."""
        lease = self.live.get(ref.lease_id)
        return lease if lease is not None and lease.ref == ref and lease.worker_id == worker_id else None

    def run_of_ended(self, ref: LeaseRef) -> str | None:
        return self._ended.get(ref.lease_id)

    def renew(self, worker_id: str, held: Iterable[LeaseRef], now_s: float) -> None:
        """The worker says that it still holds these."""
        for ref in held:
            lease = self.find(worker_id, ref)
            if lease is not None:
                lease.expires_s = now_s + self._ttl_s

    def note_progress(self, worker_id: str, told: Iterable[LeaseProgress], now_s: float) -> list[LeaseRecord]:
        """Take in how far the worker's leases have come; returns those of them that are live."""
        running: list[LeaseRecord] = []
        for progress in told:
            lease = self.find(worker_id, progress.ref)
            if lease is None:
                continue
            if progress.steps > lease.steps:
                lease.steps, lease.moved_s = progress.steps, now_s
            running.append(lease)
        return running

    def due(self, now_s: float) -> list[LeaseRecord]:
        """Live leases whose time is up."""
        late: list[LeaseRecord] = []
        # Ended leases leave as soon as they reach the head, so that they don't pile up until their expiry.
        while self._due and (self._due[0][0] <= now_s or self._due[0][2].ref.lease_id not in self.live):
            _, epoch, lease = heapq.heappop(self._due)
            if lease.ref.lease_id not in self.live:
                continue
            if lease.due_s > now_s:
                heapq.heappush(self._due, (lease.due_s, epoch, lease))
            else:
                late.append(lease)
        self.expired += len(late)
        return late

    def take_used(self) -> frozenset[tuple[str, str]]:
        """The (worker, scene) pairs that were given a lease since the last call."""
        used, self._used = frozenset(self._used), set()
        return used
