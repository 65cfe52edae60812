"""Lease table of the dispatcher."""

import heapq
import itertools
from collections import Counter, OrderedDict
from collections.abc import Iterable
from typing import Final

from embomatrix.manager.control.dispatch.fair_share import RunAccounts
from embomatrix.manager.control.dispatch.records import DispatchPhase, LeaseRecord, RolloutRecord
from embomatrix.manager.control.workers import WorkerPool, WorkerRecord
from embomatrix.rpc.wire.leases import LeaseProgress, LeaseRef

STALE_MEMORY: Final = 65_536
"""Ended leases remembered, to count a late result for its run."""


class LeaseTable:
    """Live leases. Each has an epoch that is never used again; epochs below ``first_epoch`` are a former manager's.

    ``boot_id`` keeps the lease ids of different manager processes apart.
    """

    def __init__(
        self,
        pool: WorkerPool,
        runs: RunAccounts,
        *,
        boot_id: str,
        ttl_s: float,
        limit_s: float,
        first_epoch: int = 1,
    ) -> None:
        self.live: dict[str, LeaseRecord] = {}
        #: Equals the union of ``WorkerRecord.held`` over all workers.
        self.expired = 0
        """Leases that expired, so far."""
        self.in_use: Counter[tuple[str, str]] = Counter()
        """Live leases by (worker, scene)."""
        self._used: set[tuple[str, str]] = set()
        self._pool = pool
        self._runs = runs
        self._boot_id = boot_id
        self._ttl_s = ttl_s
        self._limit_s = limit_s
        self._first_epoch = first_epoch
        self._epochs = itertools.count(first_epoch)
        self._due: list[tuple[float, int, LeaseRecord]] = []
        #: Has an entry for each live lease, at or before its ``due_s``; ended leases leave it at the head.
        self._ended: OrderedDict[str, str] = OrderedDict()
        """Run ids of ended leases, by lease id."""

    def grant(self, record: RolloutRecord, worker: WorkerRecord, now_s: float) -> LeaseRecord:
        """Create a lease with a new epoch."""
        epoch = next(self._epochs)
        return self.enter(LeaseRef(f"{self._boot_id}-{epoch}", epoch), record, worker, now_s)

    def enter(self, ref: LeaseRef, record: RolloutRecord, worker: WorkerRecord, now_s: float) -> LeaseRecord:
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
        self._pool.add_lease(worker, lease)
        heapq.heappush(self._due, (lease.due_s, ref.lease_epoch, lease))
        self._used.add((worker.worker_id, record.scene))
        self.in_use[worker.worker_id, record.scene] += 1
        return lease

    def is_former(self, ref: LeaseRef) -> bool:
        """True if a former manager granted the lease."""
        return ref.lease_epoch < self._first_epoch

    def end(self, lease: LeaseRecord, now_s: float) -> None:
        """Remove a live lease; the caller decides about its rollout."""
        lease.record.leases.remove(lease)
        del self.live[lease.ref.lease_id]
        self._pool.remove_lease(lease, now_s)
        self._runs.settle(lease, now_s)
        pair = (lease.worker_id, lease.record.scene)
        self.in_use[pair] -= 1
        if not self.in_use[pair]:
            del self.in_use[pair]
        self.remember_ended(lease.ref, lease.record.key.run_id)

    def remember_ended(self, ref: LeaseRef, run_id: str) -> None:
        """Remember a lease that ended, or was not adopted from a former manager: its result counts as stale."""
        self._ended[ref.lease_id] = run_id
        while len(self._ended) > STALE_MEMORY:
            self._ended.popitem(last=False)

    def find(self, worker_id: str, ref: LeaseRef) -> LeaseRecord | None:
        """Return the live lease with this id, epoch and worker; None for a stale one."""
        lease = self.live.get(ref.lease_id)
        return lease if lease is not None and lease.ref == ref and lease.worker_id == worker_id else None

    def run_of_ended(self, ref: LeaseRef) -> str | None:
        return self._ended.get(ref.lease_id)

    def renew(self, worker_id: str, held: Iterable[LeaseRef], now_s: float) -> None:
        for ref in held:
            lease = self.find(worker_id, ref)
            if lease is not None:
                lease.expires_s = now_s + self._ttl_s

    def note_progress(
        self, worker_id: str, reported: Iterable[LeaseProgress], now_s: float
    ) -> list[LeaseRecord]:
        """Record the steps of the worker's leases; return those of the leases that are live."""
        running: list[LeaseRecord] = []
        for progress in reported:
            lease = self.find(worker_id, progress.ref)
            if lease is None:
                continue
            if progress.steps > lease.steps:
                lease.steps, lease.moved_s = progress.steps, now_s
            running.append(lease)
        return running

    def take_expired(self, now_s: float) -> list[LeaseRecord]:
        """Return the live leases that are due; they stay live until they are ended."""
        expired: list[LeaseRecord] = []
        while self._due and (self._due[0][0] <= now_s or self._due[0][2].ref.lease_id not in self.live):
            _, epoch, lease = heapq.heappop(self._due)
            if lease.ref.lease_id not in self.live:
                continue
            if lease.due_s > now_s:
                heapq.heappush(self._due, (lease.due_s, epoch, lease))
            else:
                expired.append(lease)
        self.expired += len(expired)
        return expired

    def take_used(self) -> frozenset[tuple[str, str]]:
        """Return the (worker, scene) pairs that got a lease since the last call."""
        used, self._used = frozenset(self._used), set()
        return used

    def check_invariants(self) -> None:
        """Raise AssertionError if the table disagrees with the workers or the rollouts."""
        held = {name for worker in self._pool.workers.values() for name in worker.held}
        assert held == set(self.live)
        pairs = Counter((lease.worker_id, lease.record.scene) for lease in self.live.values())
        assert pairs == self.in_use
        assert set(self.live) <= {lease.ref.lease_id for _, _, lease in self._due}
        for lease in self.live.values():
            record = lease.record
            assert lease in record.leases, record.key
            assert record.phase is DispatchPhase.LEASED, record.key
            assert (
                len({other.worker_id for other in record.leases}) == len(record.leases) <= 1 + record.hedged
            )
