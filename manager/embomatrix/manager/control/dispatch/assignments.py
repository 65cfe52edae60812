"""Rollouts and their leases: the core of the Task-Dispatcher, without the workers' comings and goings."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from embomatrix.manager.control.audit.auditor import AuditRules
from embomatrix.manager.control.audit.audits import Audits
from embomatrix.manager.control.commands import (
    CancelLease,
    Command,
    DeliverResult,
    FinishBatch,
    GiveLease,
)
from embomatrix.manager.control.dispatch.batch_book import BatchBook
from embomatrix.manager.control.dispatch.fleet import Fleet
from embomatrix.manager.control.dispatch.group_policy import attempts_allowed, failed_with
from embomatrix.manager.control.dispatch.lease_book import LeaseBook
from embomatrix.manager.control.dispatch.ledger import (
    BatchRecord,
    DispatchPhase,
    GroupRecord,
    LeaseRecord,
    RolloutRecord,
    WorkerRecord,
)
from embomatrix.manager.control.dispatch.pending import PendingQueues
from embomatrix.manager.control.dispatch.run_book import RunBook
from embomatrix.manager.control.schedule.load_failures import LoadFailures
from embomatrix.rpc.wire.leases import LeaseOrigin
from embomatrix.rpc.wire.values import (
    Cancelled,
    InfraCode,
    InfraFailure,
    Outcome,
    RolloutResult,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from embomatrix.rpc.wire.values import Batch

CALLED_OFF = Cancelled("the trainer called it off")


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
    elsewhere_s: float = 5.0
    """A rollout that failed on a worker is not given to it again for this long, while there are others."""
    max_attempts: int = 3
    hedge_after_s: float = 1.0
    """A rollout that runs for longer than this, and than twice the 95th percentile of its run, may be started once more …"""
    hedge_share: float = 0.05
    """… but no more than this share of its run's rollouts."""
    known_after: int = 16
    """So many executions of a run tell how long the others may take."""
    stall_after_s: float = 10.0
    """A lease that runs and does no step for longer than this, and than five times the 99th percentile of its run, is void."""
    restart_grace_s: float = 5.0
    """How long a manager that took over waits for workers to say what they hold, before it gives the same to others."""
    audit: AuditRules = field(default_factory=AuditRules)
    """Which results are executed a second time."""


class Assignments:
    """Every rollout without an outcome is either queued under its scene or held by live leases: one, or two once hedged.

    ``now_s`` is set before each change; what shall be done is collected in ``commands``. ``settled`` ends a change.
    """

    def __init__(
        self, limits: DispatchLimits, *, boot_id: str, first_epoch: int = 1, audit_key: bytes = b""
    ) -> None:
        self.now_s = 0.0
        self.paused = False
        """No leases are given."""
        self.commands: list[Command] = []
        self.fleet = Fleet()
        self.runs = RunBook(limits.known_after)
        self.leases = LeaseBook(
            self.fleet,
            self.runs,
            boot_id=boot_id,
            ttl_s=limits.lease_ttl_s,
            limit_s=limits.lease_limit_s,
            first_epoch=first_epoch,
        )
        self.pending = PendingQueues(self.runs.turn)
        self.failures = LoadFailures()
        self.batches = BatchBook()
        self.audits = Audits(self, limits.audit, audit_key)
        self._limits = limits
        self._freed: dict[str, None] = {}

    def settled(self) -> list[Command]:
        """Use what became free; returns what shall be done about all since the last call, in order."""
        while self._freed:
            freed, self._freed = self._freed, {}
            self.fill(freed)
        commands, self.commands = self.commands, []
        return commands

    def queue(self, records: Sequence[RolloutRecord]) -> None:
        """Give these to whoever has their scenes warm; the others wait."""
        for record in records:
            self._queue(record)
        for scene in dict.fromkeys(record.scene for record in records):
            self.offer(scene)

    def open(self, batch: Batch, delivered: Mapping[str, int]) -> BatchRecord | None:
        """Note a batch, whose rollouts without an outcome are coming; None for one that is known."""
        key = (batch.run_id, batch.batch_id)
        if key in self.batches:
            return None
        scenes = dict.fromkeys(rollout.bundle_digest for rollout in batch.rollouts)
        run = self.runs.of(batch.run_id)
        due_s = self.now_s + (run.terms.rollout_deadline_s or self._limits.rollout_deadline_s)
        warm = {scene: self.fleet.has_warm(scene) for scene in scenes}
        noted = self.batches.open(
            batch, delivered, now_s=self.now_s, due_s=due_s, warm=warm, reward=run.terms.reward
        )
        run.submitted += noted.whole.left
        if not noted.whole.left:
            self._close(noted)
        return noted

    def queue_coming(self, batch: BatchRecord | None, count: int | None) -> None:
        """Queue the next so many of those that are coming, or all; none of a batch that is over."""
        if batch is not None:
            self.queue(self.batches.admit(batch, count))

    def cancel(self, key: tuple[str, str]) -> None:
        batch = self.batches.get(key)
        if batch is not None:
            self.batches.admit(batch)
            for record in list(batch.open.values()):
                self._conclude(record, CALLED_OFF)

    def finish(self, record: RolloutRecord, outcome: Outcome) -> None:
        """The one place where a rollout gets its outcome, and its group or batch what follows from it.

        The end of an execution that checks another's result says something of that one.
        """
        if record.check:
            self.audits.checked(record, outcome)
            return
        batch = self.batches.of(record)
        group = batch.groups[record.rollout.group_id]
        self._conclude(record, outcome)
        if isinstance(outcome, InfraFailure):
            self._fail(batch, group, f"rollout {record.key.rollout_id} was lost: {outcome.code}")

    def _fail(self, batch: BatchRecord, group: GroupRecord, why: str) -> None:
        """A member was lost: what becomes of the others is the run's policy."""
        run = self.runs.of(batch.run_id)
        late = self.batches.admit(batch)
        failed, lost = failed_with(run.terms.group_policy, batch, group)
        for one in failed:
            run.counters.groups_failed += not one.failed
            one.failed = True
        for record in lost:
            self._conclude(record, Cancelled(why))
        self.queue([record for record in late if record.phase is not DispatchPhase.DONE])

    def _conclude(self, record: RolloutRecord, outcome: Outcome) -> None:
        if record.phase is DispatchPhase.PENDING:
            self.pending.remove(record)
        for lease in list(record.leases):
            self.void(lease)
        if record.held:
            self.audits.forget(record)
        batch = self.batches.of(record)
        cursor = self.batches.conclude(record)
        counters = self.runs.of(record.key.run_id).counters
        counters.delivered += 1
        counters.infra_failures += isinstance(outcome, InfraFailure)
        result = RolloutResult(
            record.key.rollout_id, record.rollout.group_id, cursor, max(record.attempts, 1), outcome
        )
        self.commands.append(DeliverResult(batch.run_id, batch.batch_id, result))
        if not batch.whole.left:
            self._close(batch)

    def _close(self, batch: BatchRecord) -> None:
        self.batches.close(batch)
        self.commands.append(FinishBatch(batch.run_id, batch.batch_id))

    def give_back(self, lease: LeaseRecord, failure: InfraFailure, *, counted: bool) -> None:
        """A lease ended without a result: unless another one of it goes on, queue the rollout again, or end it.

        One that ended meanwhile, with its group, is left alone.
        """
        record = lease.record
        if lease not in record.leases:
            return
        self.end(lease)
        if counted:
            self._blame(record, lease.worker_id, failure)
        if record.leases or record.held:
            return
        run = self.runs.of(record.key.run_id)
        most = attempts_allowed(run.terms.group_policy, self._limits.max_attempts)
        if record.attempts >= most:
            message = f"{failure.message} (attempt {record.attempts} of {most})"
            self.finish(record, dataclasses.replace(failure, message=message))
        elif record.check:
            self.audits.returned(record)
        else:
            run.counters.redispatched += 1
            self._queue(record)

    def _blame(self, record: RolloutRecord, worker_id: str, failure: InfraFailure) -> None:
        """Count an attempt, and have the next one elsewhere if there is another worker at all."""
        record.attempts += 1
        record.out_of_memory |= failure.code is InfraCode.SLOT_OOM
        if self.fleet.live > 1:
            record.failed_on, record.avoid_until_s = worker_id, self.now_s + self._limits.elsewhere_s

    def _queue(self, record: RolloutRecord) -> None:
        if not self.pending.of_run(record.key.run_id):
            self.runs.wake(record.key.run_id)
        self.pending.push(record)

    def offer(self, scene: str) -> None:
        """Give waiting rollouts of the scene to the least busy workers that hold it warm."""
        while not self.paused:
            for record in self.pending.heads(scene):
                worker = self.fleet.best_for(scene, self._free_for(record))
                if worker is not None:
                    self.pending.take(record)
                    self.give(record, worker)
                    break
            else:
                return

    def _free_for(self, record: RolloutRecord) -> Callable[[WorkerRecord], bool]:
        return lambda worker: worker.open_credits > 0 and worker.takes(record, self.now_s)

    def fill(self, worker_ids: Iterable[str]) -> None:
        """Give freed workers the waiting rollouts of their warm scenes, by turns; the idle take from behind the busy."""
        for worker_id in worker_ids:
            worker = self.fleet.workers.get(worker_id)
            if worker is None or worker.open_credits <= 0 or self.paused:
                continue
            choice = self.pending.choice(worker, self.now_s)
            while worker.open_credits > 0 and (record := choice.next()) is not None:
                self.pending.take(record)
                self.give(record, worker)
            self._steal_for(worker)

    def hedge(self, record: RolloutRecord, worker: WorkerRecord) -> None:
        """Lease a rollout that runs elsewhere a second time; whoever is first counts."""
        record.hedged = True
        self.runs.of(record.key.run_id).counters.hedged += 1
        self.give(record, worker, hedge=True)

    def give(self, record: RolloutRecord, worker: WorkerRecord, *, hedge: bool = False) -> None:
        """Lease the rollout to the worker, which can take it."""
        lease = self.leases.give(record, worker, self.now_s)
        deadline_s = self._limits.execute_deadline_s
        origin = LeaseOrigin(*record.key, attempt=record.attempts + 1)
        self.commands.append(
            GiveLease(
                worker.worker_id,
                lease.ref,
                record.rollout,
                deadline_s,
                origin,
                hedge,
                record.check,
                record.reward,
            )
        )

    def end(self, lease: LeaseRecord) -> None:
        """The lease is over: its slot is given away when the change is settled."""
        self.leases.end(lease, self.now_s)
        self._freed[lease.worker_id] = None

    def void(self, lease: LeaseRecord) -> None:
        """Take a lease back from a worker that may still hold it."""
        self.end(lease)
        self.commands.append(CancelLease(lease.worker_id, lease.ref))

    def _steal_for(self, worker: WorkerRecord) -> None:
        """Idle slots take leases that wait behind busy slots elsewhere. They were not started: no attempt is lost."""
        before_s = self.now_s - self._limits.steal_after_s
        while worker.free_slots > 0:
            lease = self.fleet.waiting_behind(worker, before_s, self.now_s)
            if lease is None:
                return
            self.void(lease)
            self.give(lease.record, worker)

    def judge(self, scene: str) -> None:
        """End the waiting rollouts of a scene that nobody can load."""
        if self.fleet.has_warm(scene) or not self.pending.count(scene):
            return
        verdict = self.failures.verdict(
            scene, live=self.fleet.live, patience_s=self._limits.lone_load_failure_s, now_s=self.now_s
        )
        while verdict is not None and (record := self.pending.oldest(scene)) is not None:
            self.finish(record, verdict)
