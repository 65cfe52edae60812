"""Lease table of the dispatcher."""

import hashlib
import heapq
import hmac
import itertools
from collections import Counter, OrderedDict
from collections.abc import Iterable
from typing import Final

from embomatrix.manager.control.dispatch.fair_share import RunAccounts
from embomatrix.manager.control.dispatch.records import DispatchPhase, LeaseRecord, RolloutRecord
from embomatrix.manager.control.workers import WorkerPool, WorkerRecord
from embomatrix.rpc.wire.leases import LeaseOrigin, LeaseProgress, LeaseRef

STALE_MEMORY: Final = 65_536
"""Ended leases remembered, to count a late result for its run."""

ENDED_KEPT: Final = 1_024
"""Ended leases that may wait for the time at which they would have expired."""

LEASE_ID_BYTES: Final = 16


def lease_id_of(key: bytes, origin: LeaseOrigin, worker_id: str, epoch: int) -> str:
    """Return the id of a lease: its message authentication code under the cluster's secret ``key``, in hex.

    Only a manager of the cluster can make it, so a claim to a lease proves that a manager granted the lease to this
    worker. BLAKE2 with a key is such a code (RFC 7693, section 2.9).
    """
    granted = repr((origin.run_id, origin.batch_id, origin.rollout_id, origin.attempt, worker_id, epoch))
    return hashlib.blake2b(granted.encode(), key=key, digest_size=LEASE_ID_BYTES).hexdigest()


def origin_of(record: RolloutRecord) -> LeaseOrigin:
    """Return the origin of the rollout's next lease."""
    return LeaseOrigin(*record.key, attempt=record.attempts + 1)


class LeaseTable:
    """Live leases. Each has an epoch that is never used again; epochs below ``first_epoch`` are a former manager's.

    ``key`` authenticates lease ids. All managers of a cluster have the same one.
    """

    def __init__(
        self,
        pool: WorkerPool,
        runs: RunAccounts,
        *,
        key: bytes,
        ttl_s: float,
        limit_s: float,
        first_epoch: int = 1,
    ) -> None:
        self.live: dict[str, LeaseRecord] = {}
        """Equals the union of ``WorkerRecord.held`` over all workers."""
        self.expired = 0
        """Leases that expired, so far."""
        self.in_use: Counter[tuple[str, str]] = Counter()
        """Live leases by (worker, scene)."""
        self._used: set[tuple[str, str]] = set()
        self._pool = pool
        self._runs = runs
        self._key = key
        self._ttl_s = ttl_s
        self._limit_s = limit_s
        self._first_epoch = first_epoch
        self._epochs = itertools.count(first_epoch)
        self._entries = itertools.count()
        self._due: list[tuple[float, int, LeaseRecord]] = []
        """Has an entry for each live lease, at or before its ``due_s``; ended leases leave it at the head."""
        self._ended: OrderedDict[str, str] = OrderedDict()
        """Run ids of ended leases, by lease id."""

    def grant(self, record: RolloutRecord, worker: WorkerRecord, now_s: float) -> LeaseRecord:
        """Create a lease with a new epoch."""
        epoch = next(self._epochs)
        origin = origin_of(record)
        ref = LeaseRef(lease_id_of(self._key, origin, worker.worker_id, epoch), epoch)
        return self.enter(ref, record, worker, now_s)

    def enter(self, ref: LeaseRef, record: RolloutRecord, worker: WorkerRecord, now_s: float) -> LeaseRecord:
        """Enter a new lease, or one that the worker holds from a former manager and that `is_genuine`."""
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
        heapq.heappush(self._due, (lease.due_s, next(self._entries), lease))
        self._used.add((worker.worker_id, record.scene))
        self.in_use[worker.worker_id, record.scene] += 1
        return lease

    def is_genuine(self, ref: LeaseRef, origin: LeaseOrigin, worker_id: str) -> bool:
        """True if a former manager granted this lease to this worker and it is not known to have ended."""
        if ref.lease_epoch >= self._first_epoch or ref.lease_id in self.live or ref.lease_id in self._ended:
            return False
        expected = lease_id_of(self._key, origin, worker_id, ref.lease_epoch)
        return hmac.compare_digest(expected.encode(), ref.lease_id.encode())

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
        if len(self._due) > 2 * len(self.live) + ENDED_KEPT:
            # Thousands of leases a second may end behind a long one at the head.
            self._due = [entry for entry in self._due if self._is_live(entry[-1])]
            heapq.heapify(self._due)

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

    def renew(self, worker_id: str, held: Iterable[LeaseRef], now_s: float) -> list[LeaseRecord]:
        """Extend the worker's live leases by their time to live; return them."""
        renewed = [lease for ref in held if (lease := self.find(worker_id, ref)) is not None]
        for lease in renewed:
            lease.expires_s = now_s + self._ttl_s
        return renewed

    def note_progress(self, worker_id: str, reported: Iterable[LeaseProgress], now_s: float) -> None:
        """Record the steps of the worker's live leases."""
        for progress in reported:
            lease = self.find(worker_id, progress.ref)
            if lease is not None and progress.steps > lease.steps:
                lease.steps, lease.moved_s = progress.steps, now_s

    def take_expired(self, now_s: float) -> list[LeaseRecord]:
        """Return the live leases that are due; they stay live until they are ended."""
        expired: list[LeaseRecord] = []
        while self._due and (self._due[0][0] <= now_s or not self._is_live(self._due[0][2])):
            _, entry, lease = heapq.heappop(self._due)
            if not self._is_live(lease):
                continue
            if lease.due_s > now_s:
                heapq.heappush(self._due, (lease.due_s, entry, lease))
            else:
                expired.append(lease)
        self.expired += len(expired)
        return expired

    def take_used(self) -> frozenset[tuple[str, str]]:
        """Return the (worker, scene) pairs that got a lease since the last call."""
        used, self._used = frozenset(self._used), set()
        return used

    def _is_live(self, lease: LeaseRecord) -> bool:
        return self.live.get(lease.ref.lease_id) is lease

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
