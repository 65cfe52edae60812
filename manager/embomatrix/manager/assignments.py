"""Rollouts and their leases: the core of the Task-Dispatcher, without the workers' comings and goings."""

from __future__ import annotations

import dataclasses
import heapq
import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.manager.commands import (
    AcknowledgeLease,
    CancelLease,
    Command,
    DeliverResult,
    FinishBatch,
    GiveLease,
)
from embomatrix.manager.fleet import Fleet
from embomatrix.manager.lease_book import LeaseBook
from embomatrix.manager.ledger import (
    BatchRecord,
    LeaseRecord,
    PendingQueues,
    Phase,
    RolloutKey,
    RolloutRecord,
    RunCounters,
    WorkerRecord,
)
from embomatrix.manager.load_failures import LoadFailures
from embomatrix.rpc.values import (
    Cancelled,
    Completed,
    InfraCode,
    InfraFailure,
    LeaseOrigin,
    Outcome,
    RolloutResult,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from embomatrix.manager.events import BatchSubmitted, LeaseFinished
    from embomatrix.rpc.values import Batch


@dataclass(frozen=True, slots=True)
class DispatchLimits:
    """Bounds of the dispatcher; seconds, except for counts."""

    lease_ttl_s: float = 30.0
    """A lease that no heartbeat names for this long is void."""
    lease_limit_s: float = 180.0
    """A lease that was not answered after this long is void, however often it is renewed."""
    execute_deadline_s: float = 60.0
    """How long a worker may execute one plan before it kills the slot."""
    rollout_deadline_s: float = 600.0
    """From submission to outcome."""
    no_capacity_s: float = 60.0
    """How long a rollout waits while no worker could ever take it."""
    lone_load_failure_s: float = 10.0
    """How long a scene may fail to load on the only worker before its rollouts are given up."""
    steal_after_s: float = 0.05
    """A lease may be taken from behind a busy slot when it waited for this long and another slot is idle."""
    max_attempts: int = 3
    restart_grace_s: float = 5.0
    """How long a manager that took over waits for workers to say what they hold, before it gives the same to others."""


class Assignments:
    """Every rollout without an outcome is either queued under its scene or held by exactly one live lease.

    ``now_s`` is set before each change; what shall be done is collected in ``commands``.
    """

    def __init__(self, limits: DispatchLimits, *, boot_id: str, first_epoch: int = 1) -> None:
        self.now_s = 0.0
        self.commands: list[Command] = []
        self.fleet = Fleet()
        self.leases = LeaseBook(
            self.fleet,
            boot_id=boot_id,
            ttl_s=limits.lease_ttl_s,
            limit_s=limits.lease_limit_s,
            first_epoch=first_epoch,
        )
        self.pending = PendingQueues()
        self.failures = LoadFailures()
        self.batches: dict[tuple[str, str], BatchRecord] = {}
        self._limits = limits
        self._counters: dict[str, RunCounters] = {}
        self._sequences = itertools.count(1)
        self._due: list[tuple[float, int, RolloutRecord]] = []

    @property
    def runs(self) -> tuple[str, ...]:
        return tuple(self._counters)

    def counters(self, run_id: str) -> RunCounters:
        return self._counters.setdefault(run_id, RunCounters())

    def forget_run(self, run_id: str) -> None:
        """Drop the counters of a closed run."""
        self._counters.pop(run_id, None)

    def pending_of(self, run_id: str) -> int:
        """Rollouts of the run without an outcome."""
        return sum(len(batch.open) for key, batch in self.batches.items() if key[0] == run_id)

    def submit(self, event: BatchSubmitted) -> None:
        self.queue(self.take_in(event.batch, {}))

    def queue(self, records: Sequence[RolloutRecord]) -> None:
        """Give these to whoever has their scenes warm; the others wait."""
        for record in records:
            self.pending.push(record)
        for scene in dict.fromkeys(record.scene for record in records):
            self.offer(scene)

    def take_in(self, batch: Batch, delivered: Mapping[str, int]) -> list[RolloutRecord]:
        """Note a batch; returns its rollouts without an outcome, which nobody holds. None of a batch that is known."""
        key = (batch.run_id, batch.batch_id)
        if key in self.batches:
            return []
        noted = self.batches[key] = BatchRecord(*key, {}, cursor=max(delivered.values(), default=0))
        scenes = dict.fromkeys(rollout.bundle_digest for rollout in batch.rollouts)
        warm = {scene: self.fleet.has_warm(scene) for scene in scenes}
        due_s = self.now_s + self._limits.rollout_deadline_s
        for rollout in batch.rollouts:
            if rollout.rollout_id in delivered:
                continue
            record = RolloutRecord(
                key=RolloutKey(*key, rollout.rollout_id),
                rollout=rollout,
                sequence=next(self._sequences),
                submitted_s=self.now_s,
                warm=warm[rollout.bundle_digest],
            )
            noted.open[rollout.rollout_id] = record
            heapq.heappush(self._due, (due_s, record.sequence, record))
        if not noted.open:
            self._close(noted)
        return list(noted.open.values())

    def cancel(self, key: tuple[str, str]) -> None:
        batch = self.batches.get(key)
        if batch is None:
            return
        records = list(batch.open.values())
        freed = {record.lease.worker_id: None for record in records if record.lease is not None}
        for record in records:
            self.finish(record, Cancelled())
        self.fill(freed)

    def cancel_run(self, run_id: str) -> None:
        for key in [key for key in self.batches if key[0] == run_id]:
            self.cancel(key)

    def finish(self, record: RolloutRecord, outcome: Outcome) -> None:
        """The one place where a rollout gets its outcome."""
        if record.phase is Phase.PENDING:
            self.pending.remove(record)
        if record.lease is not None:
            self.void(record.lease)
        record.phase = Phase.DONE
        batch = self.batches[record.key[:2]]
        del batch.open[record.key.rollout_id]
        batch.cursor += 1
        counters = self.counters(record.key.run_id)
        counters.delivered += 1
        counters.infra_failures += isinstance(outcome, InfraFailure)
        result = RolloutResult(
            record.key.rollout_id, record.rollout.group_id, batch.cursor, max(record.attempts, 1), outcome
        )
        self.commands.append(DeliverResult(batch.run_id, batch.batch_id, result))
        if not batch.open:
            self._close(batch)

    def _close(self, batch: BatchRecord) -> None:
        del self.batches[batch.run_id, batch.batch_id]
        self.commands.append(FinishBatch(batch.run_id, batch.batch_id))

    def give_back(self, lease: LeaseRecord, failure: InfraFailure, *, counted: bool) -> None:
        """A lease ended without a result: queue the rollout again, or end it when its attempts are used up."""
        record = lease.record
        self.leases.end(lease)
        record.attempts += counted
        if record.attempts >= self._limits.max_attempts:
            message = f"{failure.message} (attempt {record.attempts} of {self._limits.max_attempts})"
            self.finish(record, dataclasses.replace(failure, message=message))
        else:
            self.counters(record.key.run_id).redispatched += 1
            self.pending.push(record)

    def offer(self, scene: str) -> None:
        """Give waiting rollouts of the scene to the least busy workers that hold it warm."""
        while self.pending.count(scene):
            worker = self.fleet.best_for(scene)
            if worker is None:
                return
            self._give(self.pending.pop(scene), worker)

    def fill(self, worker_ids: Iterable[str]) -> None:
        """Give freed workers the oldest waiting rollouts of their warm scenes; the idle take from behind the busy."""
        for worker_id in worker_ids:
            worker = self.fleet.workers.get(worker_id)
            while worker is not None and worker.open_credits > 0:
                scene = self.pending.first_of(worker.warm)
                if scene is None:
                    self._steal_for(worker)
                    break
                self._give(self.pending.pop(scene), worker)

    def _give(self, record: RolloutRecord, worker: WorkerRecord) -> None:
        lease = self.leases.give(record, worker, self.now_s)
        deadline_s = self._limits.execute_deadline_s
        origin = LeaseOrigin(*record.key, attempt=record.attempts + 1)
        self.commands.append(GiveLease(worker.worker_id, lease.ref, record.rollout, deadline_s, origin))

    def void(self, lease: LeaseRecord) -> None:
        """Take a lease back from a worker that may still hold it."""
        self.leases.end(lease)
        self.commands.append(CancelLease(lease.worker_id, lease.ref))

    def _steal_for(self, worker: WorkerRecord) -> None:
        """Idle slots take leases that wait behind busy slots elsewhere. They were not started: no attempt is lost."""
        before_s = self.now_s - self._limits.steal_after_s
        while worker.free_slots > 0:
            lease = self.fleet.waiting_behind(worker, before_s)
            if lease is None:
                return
            self.void(lease)
            self._give(lease.record, worker)

    def settle(self, event: LeaseFinished) -> None:
        self.commands.append(AcknowledgeLease(event.worker_id, event.ref))
        lease = self.leases.find(event.worker_id, event.ref)
        if lease is None:
            run_id = self.leases.run_of_ended(event.ref)
            if run_id in self._counters:
                self._counters[run_id].stale_results += 1
            return
        match event.outcome:
            case Completed() as completed:
                self._complete(lease, completed)
            case InfraFailure() as failure:
                self._fail(
                    lease, dataclasses.replace(failure, worker_id=failure.worker_id or event.worker_id)
                )
        self.fill([event.worker_id])

    def _complete(self, lease: LeaseRecord, completed: Completed) -> None:
        record = lease.record
        self.leases.end(lease)
        record.attempts += 1
        counters = self.counters(record.key.run_id)
        counters.warm_starts += record.warm
        counters.cold_starts += not record.warm
        self.fleet.workers[lease.worker_id].completed += 1
        timings = lease.timings(completed.timings, self.now_s)
        warm = record.warm and completed.warm
        self.finish(record, completed.noted(timings=timings, warm=warm))

    def _fail(self, lease: LeaseRecord, failure: InfraFailure) -> None:
        worker = self.fleet.workers[lease.worker_id]
        scene = lease.record.scene
        if failure.code in (InfraCode.SCENE_LOAD_FAILED, InfraCode.BUNDLE_CORRUPT):
            # Until the worker reports again it is not taken for warm: the rollout would come straight back.
            self.fleet.set_warm(worker, worker.warm - {scene})
            self.failures.record(scene, worker.worker_id, failure.message, self.now_s)
        self.give_back(lease, failure, counted=True)
        self.judge(scene)
        self.offer(scene)

    def judge(self, scene: str) -> None:
        """End the waiting rollouts of a scene that nobody can load."""
        if self.fleet.has_warm(scene) or not self.pending.count(scene):
            return
        verdict = self.failures.verdict(
            scene, live=self.fleet.live, patience_s=self._limits.lone_load_failure_s, now_s=self.now_s
        )
        while verdict is not None and self.pending.count(scene):
            self.finish(self.pending.pop(scene), verdict)

    def overdue(self) -> list[RolloutRecord]:
        """Rollouts whose deadline has passed without an outcome."""
        late: list[RolloutRecord] = []
        # Deadlines come in order of submission: what is done leaves at the head and doesn't pile up until its deadline.
        while self._due and (self._due[0][2].phase is Phase.DONE or self._due[0][0] <= self.now_s):
            record = heapq.heappop(self._due)[2]
            if record.phase is not Phase.DONE:
                late.append(record)
        return late
