"""Audits as leases: a result that is to be compared has its rollout executed by another worker, and by a third on a mismatch.

A further execution is a rollout record of its own (``check``), which no batch has and whose end comes here. To its worker it
looks like any other. Of a run that wants verified results it waits in the queue with the others, and the result it is about is
held back; of any other run it gets a slot that is idle while nothing else waits for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.audit.auditor import Auditor, AuditRules, Opinion, Ruling, judge, opinion_of
from embomatrix.manager.control.commands import CancelLease, QuarantineWorker
from embomatrix.manager.control.dispatch.ledger import DispatchPhase, RolloutKey, RolloutRecord
from embomatrix.rpc.wire.values import Completed, InfraCode, InfraFailure

if TYPE_CHECKING:
    from embomatrix.manager.control.dispatch.assignments import Assignments
    from embomatrix.manager.control.dispatch.ledger import LeaseRecord, WorkerRecord
    from embomatrix.rpc.wire.values import Outcome

LOOKED_AT: Final = 256
"""Audits that are looked at in one go, each time others."""


@dataclass(slots=True, eq=False)
class Case:
    """A result and what others came to. ``held`` is its rollout while it waits for that; None once it was delivered."""

    key: RolloutKey
    held: RolloutRecord | None
    check: RolloutRecord
    opinions: list[Opinion]
    results: list[Completed]
    """Beside the opinions, of a held rollout: one of them will be delivered."""
    disputed: tuple[str, ...] = ()
    """Who contradict one another."""
    alone_s: float | None = None
    """Since when nobody is there who could execute it."""


class Audits:
    """Every case has a check that waits or runs. The desk tells of what ends; ``look`` when the clock says so."""

    def __init__(self, desk: Assignments, rules: AuditRules, key: bytes) -> None:
        self.auditor = Auditor(rules, key)
        self._desk = desk
        self._cases: dict[RolloutKey, Case] = {}

    def hold(self, lease: LeaseRecord, completed: Completed) -> bool:
        """Note a result that may have to be compared; tells whether it waits for that."""
        record, worker_id = lease.record, lease.worker_id
        if record.held:
            return True  # a second lease of it was live still: what is under way tells
        verified = self._desk.runs.of(record.key.run_id).terms.verified
        if not self.auditor.wants(worker_id, lease.ref.lease_id, verified=verified):
            return False
        if record.key in self._cases or (not verified and len(self._cases) >= self.auditor.rules.backlog):
            return False
        check = self._check(record, frozenset({worker_id}))
        if not self._somebody_for(check):
            self.auditor.lone = True
            return False
        self.auditor.lone = False
        self.auditor.took(worker_id)
        opinion = opinion_of(worker_id, self._desk.fleet.workers[worker_id].versions, completed)
        case = Case(
            record.key, record if verified else None, check, [opinion], [completed] if verified else []
        )
        self._cases[case.key] = case
        record.held = verified
        if verified:
            for other in list(record.leases):
                self._desk.void(other)
            self._ask(case)
        return verified

    def checked(self, check: RolloutRecord, outcome: Outcome) -> None:
        """A further execution has ended, or will never be."""
        case = self._cases.get(check.key)
        if case is None or case.check is not check:
            return
        if not isinstance(outcome, Completed):
            failure = (
                outcome if isinstance(outcome, InfraFailure) else InfraFailure(InfraCode.DEADLINE, "no audit")
            )
            self._give_up(case, failure)
            return
        worker = self._desk.fleet.workers[outcome.worker_id]
        case.opinions.append(opinion_of(worker.worker_id, worker.versions, outcome))
        if case.held is not None:
            case.results.append(outcome)
        self._rule(case)

    def returned(self, check: RolloutRecord) -> None:
        """Its lease ended without a result: another worker shall do it."""
        case = self._cases.get(check.key)
        if case is not None and case.check is check and case.held is not None:
            self._desk.queue([check])

    def forget(self, record: RolloutRecord) -> None:
        """A rollout that was held back has got its outcome otherwise."""
        record.held = False
        case = self._cases.get(record.key)
        if case is not None:
            case.held = None
            self._close(case)

    def drop_run(self, run_id: str) -> None:
        """The run is over, and so are its audits."""
        for case in [case for case in self._cases.values() if case.key.run_id == run_id]:
            self._close(case)

    def joined(self, worker: WorkerRecord) -> None:
        """A new session changes nothing of what a worker did."""
        worker.quarantined = bool(self.auditor.quarantined(worker.worker_id))
        self._desk.fleet.stand(worker)

    def pardon(self, worker: WorkerRecord) -> None:
        """An operator trusts it again."""
        self.auditor.pardon(worker.worker_id)
        self.joined(worker)

    def look(self) -> None:
        """Give audits that can wait to slots that nobody wants, and end those that nobody can do."""
        some = list(islice(self._cases.items(), LOOKED_AT))
        for key, case in some:
            del self._cases[key]
            self._cases[key] = case
        for _, case in some:
            if case.check.leases or self._cases.get(case.key) is not case:
                continue
            if self._somebody_for(case.check):
                case.alone_s = None
                if case.held is None:
                    self._use_idle_slot(case.check)
                continue
            case.alone_s = self._desk.now_s if case.alone_s is None else case.alone_s
            if self._desk.now_s - case.alone_s >= self.auditor.rules.patience_s:
                self._leave_alone(case)

    def _use_idle_slot(self, check: RolloutRecord) -> None:
        desk = self._desk

        def idle(worker: WorkerRecord) -> bool:
            return worker.free_slots > 0 and worker.takes(check, desk.now_s)

        worker = desk.fleet.best_for(check.scene, idle)
        if worker is not None and not desk.paused and not desk.pending.count(check.scene):
            desk.give(check, worker)

    def _rule(self, case: Case) -> None:
        verdict = judge(case.opinions)
        match verdict.ruling:
            case Ruling.OPEN:
                case.disputed = tuple(opinion.worker_id for opinion in case.opinions)
                for worker_id in case.disputed:
                    self.auditor.of(worker_id).disputed += 1
                case.check = self._check(case.check, frozenset(o.worker_id for o in case.opinions))
                case.alone_s = None
                if case.held is not None:
                    self._ask(case)
            case Ruling.SPLIT:
                self._give_up(case, self._mismatch(case))
            case Ruling.AGREED:
                self._count(case, mismatch=len(case.opinions) > 2)
                for at in verdict.right:
                    self.auditor.agreed(case.opinions[at].worker_id)
                held = case.held
                self._close(case)
                if held is not None:
                    held.held = False
                    self._desk.finish(held, case.results[verdict.right[0]])
                for at in verdict.wrong:
                    self._convict(case.opinions[at].worker_id, case)

    def _convict(self, worker_id: str, case: Case) -> None:
        """It gets nothing more, and what it did and nobody has seen yet is done again."""
        others = " and ".join(o.worker_id for o in case.opinions if o.worker_id != worker_id)
        reason = f"its result of rollout {case.key.rollout_id} of run {case.key.run_id} contradicts {others}"
        known = self.auditor.quarantined(worker_id)
        self.auditor.convict(worker_id, known or reason)
        if known:
            return  # another of its executions was under way
        desk = self._desk
        audited = self.auditor.of(worker_id).audited
        desk.commands.append(QuarantineWorker(worker_id, reason, audited))
        again = [other for other in self._cases.values() if other.opinions[0].worker_id == worker_id]
        for other in again:
            held = other.held
            self._close(other)
            if held is not None:
                held.held = False
                desk.runs.of(other.key.run_id).counters.redispatched += 1
                desk.queue([held])
        worker = desk.fleet.workers.get(worker_id)
        if worker is not None:
            self._shut_out(worker)

    def _shut_out(self, worker: WorkerRecord) -> None:
        """What it holds goes to others."""
        desk = self._desk
        worker.quarantined = True
        desk.fleet.stand(worker)
        failure = InfraFailure(InfraCode.WORKER_LOST, "its worker is in quarantine", worker.worker_id)
        leases = list(worker.held.values())
        for lease in leases:
            desk.commands.append(CancelLease(worker.worker_id, lease.ref))
            desk.give_back(lease, failure, counted=False)
        for scene in dict.fromkeys(lease.record.scene for lease in leases):
            desk.offer(scene)

    def _leave_alone(self, case: Case) -> None:
        """Nobody is left who could compare: with one opinion it has to do, with two nobody knows which is right."""
        if len(case.opinions) > 1:
            self._give_up(case, self._mismatch(case))
            return
        self.auditor.lone = True
        held = case.held
        self._close(case)
        if held is not None:
            held.held = False
            self._desk.finish(held, case.results[0])

    def _give_up(self, case: Case, failure: InfraFailure) -> None:
        """Nothing can be said of the result: a rollout that was held back has none, and nobody is blamed."""
        if len(case.opinions) > 1:
            self._count(case, mismatch=True)
            failure = self._mismatch(case)
        held = case.held
        self._close(case)
        if held is not None:
            held.held = False
            self._desk.finish(held, failure)

    def _mismatch(self, case: Case) -> InfraFailure:
        names = ", ".join(opinion.worker_id for opinion in case.opinions)
        return InfraFailure(
            InfraCode.RESULT_MISMATCH,
            f"{names} came to different results, and no two others agree with either",
        )

    def _count(self, case: Case, *, mismatch: bool) -> None:
        counters = self._desk.runs.of(case.key.run_id).counters
        counters.audited += 1
        counters.audit_mismatches += mismatch

    def _check(self, record: RolloutRecord, barred: frozenset[str]) -> RolloutRecord:
        return RolloutRecord(
            key=record.key,
            rollout=record.rollout,
            sequence=record.sequence,
            submitted_s=self._desk.now_s,
            warm=record.warm,
            check=True,
            barred=barred,
            reward=record.reward,
        )

    def _somebody_for(self, check: RolloutRecord) -> bool:
        """Whether a worker is there that may execute it some time."""
        return any(
            name not in check.barred
            and not (worker.quarantined or worker.draining)
            and (worker.render_slots > 0 or not check.rollout.render)
            for name, worker in self._desk.fleet.workers.items()
        )

    def _ask(self, case: Case) -> None:
        self._desk.queue([case.check])

    def _close(self, case: Case) -> None:
        """End the case, and its check wherever that is."""
        self._cases.pop(case.key, None)
        for worker_id in case.disputed:
            self.auditor.of(worker_id).disputed -= 1
        case.disputed = ()
        check = case.check
        if check.phase is DispatchPhase.PENDING:
            self._desk.pending.remove(check)
        for lease in list(check.leases):
            self._desk.void(lease)
        check.phase = DispatchPhase.DONE
