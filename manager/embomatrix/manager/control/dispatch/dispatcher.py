"""Task-Dispatcher: gives each rollout to a slot that has its scene warm, and gets exactly one outcome for it.

A pure state machine: ``handle`` is the only way to change it, the clock is an argument, and what shall be done comes back
as commands. The rules it keeps:

* A lease goes only to a worker that *reported* the scene as warm. A rollout that waits shows in ``demand``, where the
  Resource-Scheduler sees it and has the scene loaded.
* Whoever has a free credit and a warm scene never waits while a rollout of that scene does.
* Every lease has an epoch of its own. A result under any other epoch is acknowledged, counted as stale and dropped.
* Only leases that were started cost an attempt. After ``max_attempts`` the rollout ends as an infrastructure failure, and
  what becomes of its group is the run's policy.
* A rollout has one live lease, or two on different workers when the first is late; the first good result counts.
* A result that is audited is compared with what a second worker comes to: see ``audits``.
* Runs take turns by weight; the slot time that they had decides, not how many leases.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.commands import CancelLease, Command
from embomatrix.manager.control.dispatch.assignments import Assignments, DispatchLimits
from embomatrix.manager.control.dispatch.attendance import Attendance
from embomatrix.manager.control.dispatch.hedging import Hedger
from embomatrix.manager.control.dispatch.lease_ends import LeaseEnds
from embomatrix.manager.control.dispatch.queue_timeouts import QueueTimeouts
from embomatrix.manager.control.dispatch.recovery import Recovery
from embomatrix.manager.control.events import (
    BatchCancelled,
    BatchContinued,
    BatchRestored,
    BatchSubmitted,
    DemandObserved,
    DispatchPaused,
    DispatchResumed,
    Event,
    LeaseFinished,
    LeasesRenewed,
    ReputesKnown,
    RunClosed,
    RunOpened,
    ScenesUnplaceable,
    Tick,
    WorkerDrained,
    WorkerJoined,
    WorkerLost,
    WorkerRecovered,
    WorkerReported,
    WorkerResumed,
    WorkersExpected,
    WorkerSuspected,
)
from embomatrix.rpc.wire.values import InfraCode, InfraFailure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.manager.control.audit.auditor import Auditor
    from embomatrix.manager.control.dispatch.ledger import LeaseRecord, RunCounters, WorkerRecord


STALL_TIMES: Final = 5.0
"""A lease has stalled after so many times the 99th percentile of its run's slot times without a step."""


class Dispatcher:
    """Batches in, leases and results out. ``boot_id`` keeps lease ids of different manager processes apart.

    ``first_epoch`` lies above the epochs of every lease that a former manager gave. Whoever knows ``audit_key`` can tell
    which results will be audited.
    """

    def __init__(
        self, limits: DispatchLimits, *, boot_id: str, first_epoch: int = 1, audit_key: bytes = b""
    ) -> None:
        self._limits = limits
        self._desk = Assignments(limits, boot_id=boot_id, first_epoch=first_epoch, audit_key=audit_key)
        self._recovery = Recovery(self._desk, grace_s=limits.restart_grace_s)
        self._attendance = Attendance(self._desk, self._recovery)
        self._ends = LeaseEnds(self._desk)
        self._hedger = Hedger(self._desk, limits)
        self._patience = QueueTimeouts(self._desk, limits.no_capacity_s)

    def handle(self, *events: Event, now_s: float) -> list[Command]:
        """Take in facts of one moment; returns what shall be done about them, in order. Leases are given after all of them."""
        self._desk.now_s = now_s
        for event in events:
            self._take(event)
        return self._desk.settled()

    def _take(self, event: Event) -> None:
        match event:
            case LeaseFinished():
                self._ends.settle(event)
            case LeasesRenewed():
                self._on_renewed(event)
            case RunOpened(run_id, terms):
                self._desk.runs.open(run_id, terms)
            case DispatchPaused() | DispatchResumed():
                self._desk.paused = isinstance(event, DispatchPaused)
                self._desk.fill(list(self._desk.fleet.workers))
            case BatchSubmitted(submitted, count):
                self._desk.queue_coming(self._desk.open(submitted, {}), count)
            case BatchContinued(run_id, batch_id, count):
                self._desk.queue_coming(self._desk.batches.get((run_id, batch_id)), count)
            case BatchRestored():
                self._recovery.restore(event)
            case WorkersExpected(worker_ids):
                self._recovery.expect(worker_ids)
            case ReputesKnown(reputes):
                self._desk.audits.auditor.know(reputes)
            case BatchCancelled(run_id, batch_id):
                self._desk.cancel((run_id, batch_id))
            case RunClosed(run_id):
                for batch in self._desk.batches.of_run(run_id):
                    self._desk.cancel((run_id, batch.batch_id))
                self._desk.audits.drop_run(run_id)
            case WorkerJoined():
                self._attendance.joined(event)
            case WorkerReported():
                self._attendance.reported(event)
            case WorkerLost():
                self._attendance.lost(event)
            case WorkerSuspected() | WorkerRecovered() | WorkerDrained() | WorkerResumed():
                self._attendance.standing(event)
            case ScenesUnplaceable(reasons):
                self._patience.note_unplaceable(reasons)
            case Tick():
                self._on_tick()

    def demand(self) -> DemandObserved:
        """What the Resource-Scheduler should know now. Forgets which leases were given since the last call."""
        desk = self._desk
        pending = desk.pending.counts()
        lanes = [heads for scene in pending if (heads := desk.pending.heads(scene))]
        lanes.sort(key=lambda heads: desk.runs.turn(heads[0]))
        waited_s = {heads[0].scene: desk.now_s - min(h.submitted_s for h in heads) for heads in lanes}
        # What is waited for will be executed somewhere, and what is late elsewhere as well: their scenes are loaded meanwhile.
        awaited = {scene: (count, 0.0) for scene, count in self._recovery.awaited().items()}
        for scene, (count, held_s) in (*awaited.items(), *self._hedger.wanted.items()):
            pending[scene] = pending.get(scene, 0) + count
            waited_s.setdefault(scene, held_s)
        return DemandObserved(
            pending=pending,
            waited_s=waited_s,
            in_use=frozenset(desk.leases.in_use),
            used=desk.leases.take_used(),
            idle=desk.fleet.idle if pending else frozenset(),
            lags=dict(desk.fleet.lags),
            runs={heads[0].scene: heads[0].key.run_id for heads in lanes},
            rendering=frozenset(h.scene for heads in lanes for h in heads if h.rollout.render),
        )

    @property
    def waiting_scenes(self) -> int:
        """How many scenes have waiting or late rollouts; when it changes, the scheduler should look again."""
        return self._desk.pending.scenes + len(self._recovery.awaited()) + len(self._hedger.wanted)

    @property
    def queued(self) -> int:
        """Rollouts that wait for a lease."""
        return len(self._desk.pending) + self._desk.batches.coming + self._recovery.waiting

    @property
    def expired(self) -> int:
        """Leases whose time was up, so far."""
        return self._desk.leases.expired

    @property
    def expected(self) -> frozenset[str]:
        """Workers of a former manager that were not heard yet, while they are waited for."""
        return self._recovery.expected

    @property
    def auditor(self) -> Auditor:
        """What is known of workers' honesty; for reading."""
        return self._desk.audits.auditor

    @property
    def scenes(self) -> frozenset[str]:
        """Scenes of rollouts without an outcome."""
        return self._desk.batches.scenes()

    @property
    def live_leases(self) -> Mapping[str, LeaseRecord]:
        return self._desk.leases.live

    @property
    def workers(self) -> Mapping[str, WorkerRecord]:
        return self._desk.fleet.workers

    @property
    def runs(self) -> tuple[str, ...]:
        """Runs with counters."""
        return tuple(self._desk.runs)

    def counters(self, run_id: str) -> RunCounters:
        return self._desk.runs.of(run_id).counters

    def forget_run(self, run_id: str) -> None:
        """Drop the counters of a closed run."""
        self._desk.runs.forget(run_id)

    def pending_of(self, run_id: str) -> int:
        """Rollouts of the run without an outcome."""
        return sum(batch.whole.left for batch in self._desk.batches.of_run(run_id))

    def waiting_scenes_of(self, run_id: str) -> frozenset[str]:
        """Scenes of the run's rollouts without an outcome."""
        return frozenset().union(*(batch.open_scenes for batch in self._desk.batches.of_run(run_id)))

    def _on_renewed(self, event: LeasesRenewed) -> None:
        """Whoever lives and does no step any more is stuck: liveness alone renews no lease for ever."""
        leases, now_s = self._desk.leases, self._desk.now_s
        leases.renew(event.worker_id, event.held, now_s)
        for lease in leases.note_progress(event.worker_id, event.progress, now_s):
            flat_s = now_s - lease.moved_s
            if flat_s >= self._stall_after_s(lease):
                text = f"{event.worker_id} did no step for {flat_s:.0f} s, after {lease.steps}"
                failure = InfraFailure(InfraCode.STALLED, text, event.worker_id)
                self._take_away(lease, failure, started=lease.started_s is not None)

    def _stall_after_s(self, lease: LeaseRecord) -> float:
        usual_s = self._desk.runs.of(lease.record.key.run_id).times.quantile_s(0.99)
        if usual_s is None:
            return self._limits.execute_deadline_s  # nobody knows yet how long a step of this run may take
        return max(self._limits.stall_after_s, STALL_TIMES * usual_s)

    def _on_tick(self) -> None:
        self._recovery.tick()
        # Ending a lease starts the next one behind its slot: a lease that expires now counts only if it ran before.
        expired = [(lease, lease.started_s is not None) for lease in self._desk.leases.due(self._desk.now_s)]
        for lease, started in expired:
            self._expire(lease, started=started)
        for record, had_s in self._desk.batches.overdue(self._desk.now_s):
            message = f"no outcome within {had_s:g} s of its submission"
            self._desk.finish(record, InfraFailure(InfraCode.DEADLINE, message))
        for scene in self._desk.failures.scenes():
            self._desk.judge(scene)
        self._patience.give_up()
        self._seek()
        self._hedger.look()
        self._desk.audits.look()

    def _seek(self) -> None:
        """Free slots look again. Time alone makes a rollout somebody's that it was not: it waited for longer than a slow
        worker holds back, or failed there long enough ago.
        """
        fleet = self._desk.fleet
        forgiven = fleet.forgive() if fleet.live <= 1 else []
        if not self._desk.pending.scenes and not fleet.backlogged:
            return  # nobody waits, neither for a lease nor behind a busy slot
        self._desk.fill([*forgiven, *fleet.seekers(), *fleet.lags])

    def _expire(self, lease: LeaseRecord, *, started: bool) -> None:
        if lease.expires_s <= self._desk.now_s:
            message = f"{lease.worker_id} did not renew the lease for {self._limits.lease_ttl_s:g} s"
        else:
            message = f"{lease.worker_id} gave no result within {self._limits.lease_limit_s:g} s"
        failure = InfraFailure(InfraCode.LEASE_EXPIRED, message, lease.worker_id)
        self._take_away(lease, failure, started=started)

    def _take_away(self, lease: LeaseRecord, failure: InfraFailure, *, started: bool) -> None:
        """The worker had its chance: another one gets the rollout."""
        if lease not in lease.record.leases:
            return  # it ended with its group a moment ago
        self._desk.commands.append(CancelLease(lease.worker_id, lease.ref))
        self._desk.give_back(lease, failure, counted=started)
        self._desk.offer(lease.record.scene)
