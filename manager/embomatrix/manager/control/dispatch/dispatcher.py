"""Task-Dispatcher: leases each rollout to a slot that has its scene warm, and delivers exactly one outcome for it.

A pure state machine: ``handle`` is the only way to change it, the clock is an argument, commands are the result. Its rules:

* A lease goes only to a worker that *reported* the scene as warm. Waiting rollouts appear in ``demand``; the
  Resource-Scheduler then has their scenes loaded.
* A worker with a free credit and a warm scene never idles while a rollout of that scene waits that it may take.
* Every lease has a unique epoch. A result under any other epoch is acknowledged, counted as stale and dropped.
* Only leases that started cost an attempt. After ``max_attempts`` the rollout ends as an infrastructure failure, and the
  run's group policy decides about the rest of the group.
* A rollout has one live lease, or two on different workers if the first is late; the first good result counts.
* An audited result is compared with a second worker's: see ``audits``.
* Runs share slot time by weight: see ``fair_share``.

`DispatchState` owns all state. The other modules of this package are functions of it, in layers: ``leasing``, ``outcomes``,
``audits``, ``lease_results``, ``membership``, ``deadlines``; each uses only those before it.
"""

from collections.abc import Mapping

from embomatrix.manager.control.commands import ManagerCommand
from embomatrix.manager.control.dispatch.audits import drop_run, quarantine
from embomatrix.manager.control.dispatch.deadlines import note_unplaceable, renew_leases, tick
from embomatrix.manager.control.dispatch.lease_results import settle_result
from embomatrix.manager.control.dispatch.leasing import fill_freed, fill_workers
from embomatrix.manager.control.dispatch.membership import (
    restore_batch,
    standing_changed,
    worker_joined,
    worker_lost,
    worker_reported,
)
from embomatrix.manager.control.dispatch.outcomes import cancel_batch, open_batch, queue_next
from embomatrix.manager.control.dispatch.records import DispatchPhase, LeaseRecord, RunCounters
from embomatrix.manager.control.dispatch.state import DispatchLimits, DispatchState
from embomatrix.manager.control.events import (
    BatchCancelled,
    BatchContinued,
    BatchRestored,
    BatchSubmitted,
    DemandObserved,
    DrainChanged,
    Event,
    LeaseFinished,
    LeasesRenewed,
    PauseChanged,
    ReputationsKnown,
    RunClosed,
    RunOpened,
    ScenesUnplaceable,
    SuspicionChanged,
    Tick,
    WorkerFaulted,
    WorkerJoined,
    WorkerLost,
    WorkerReported,
    WorkersExpected,
)
from embomatrix.manager.control.workers import WorkerRecord


class Dispatcher:
    """Batches in, leases and results out.

    ``lease_key`` is the cluster's secret for lease ids. ``first_epoch`` is above the epoch of every lease that a former
    manager granted. ``audit_key`` is secret: it determines which results will be audited.
    """

    def __init__(
        self, limits: DispatchLimits, *, lease_key: bytes, first_epoch: int = 1, audit_key: bytes = b""
    ) -> None:
        self.state = DispatchState(limits, lease_key=lease_key, first_epoch=first_epoch, audit_key=audit_key)
        self.auditor = self.state.auditor
        self.live_leases: Mapping[str, LeaseRecord] = self.state.leases.live
        self.workers: Mapping[str, WorkerRecord] = self.state.pool.workers

    def handle(self, *events: Event, now_s: float) -> list[ManagerCommand]:
        """Apply events of one moment; return the commands in order. Freed slots are filled after all events."""
        state = self.state
        state.now_s = now_s
        for event in events:
            state.cause = event
            self._apply(event)
        fill_freed(state)
        return state.take_commands()

    def _apply(self, event: Event) -> None:
        state = self.state
        match event:
            case LeaseFinished():
                settle_result(state, event)
            case LeasesRenewed():
                renew_leases(state, event)
            case RunOpened(run_id, terms):
                state.runs.of(run_id).terms = terms
            case PauseChanged(paused):
                state.paused = paused
                fill_workers(state, list(state.pool.workers))
            case BatchSubmitted(batch, count):
                queue_next(state, open_batch(state, batch, {}), count)
            case BatchContinued(run_id, batch_id, count):
                queue_next(state, state.batches.get((run_id, batch_id)), count)
            case BatchRestored():
                restore_batch(state, event)
            case WorkersExpected(worker_ids):
                state.expected_workers = set(worker_ids)
            case ReputationsKnown(reputations):
                state.auditor.know(reputations)
            case BatchCancelled(run_id, batch_id):
                cancel_batch(state, (run_id, batch_id))
            case RunClosed(run_id):
                for open_one in state.batches.of_run(run_id):
                    cancel_batch(state, (run_id, open_one.batch_id))
                drop_run(state, run_id)
            case WorkerJoined():
                worker_joined(state, event)
            case WorkerReported():
                worker_reported(state, event)
            case WorkerLost():
                worker_lost(state, event)
            case WorkerFaulted(worker_id, reason):
                quarantine(state, worker_id, reason)
            case SuspicionChanged() | DrainChanged():
                standing_changed(state, event)
            case ScenesUnplaceable(reasons):
                note_unplaceable(state, reasons)
            case Tick():
                tick(state)

    def demand(self) -> DemandObserved:
        """Return the demand for scenes. Resets the record of leases granted since the last call."""
        state = self.state
        pending = state.queues.counts()
        scenes = [heads for scene in pending if (heads := state.queues.heads(scene))]
        scenes.sort(key=lambda heads: state.runs.turn(heads[0]))
        waited_s = {heads[0].scene: state.now_s - min(h.submitted_s for h in heads) for heads in scenes}
        # Awaited rollouts and hedges will run somewhere: their scenes are loaded meanwhile.
        awaited = {scene: (count, 0.0) for scene, count in state.awaited_scenes.items()}
        for scene, (count, held_s) in (*awaited.items(), *state.hedge_wanted.items()):
            pending[scene] = pending.get(scene, 0) + count
            waited_s.setdefault(scene, held_s)
        return DemandObserved(
            pending=pending,
            waited_s=waited_s,
            in_use=frozenset(state.leases.in_use),
            used=state.leases.take_used(),
            idle=state.pool.idle if pending else frozenset(),
            lags=dict(state.pool.lags),
            runs={heads[0].scene: heads[0].key.run_id for heads in scenes},
            rendering=frozenset(h.scene for heads in scenes for h in heads if h.queue.render),
        )

    @property
    def waiting_scenes(self) -> int:
        """Number of scenes with waiting or late rollouts; a change calls for a new placement."""
        state = self.state
        return state.queues.scene_count + len(state.awaited_scenes) + len(state.hedge_wanted)

    @property
    def queued(self) -> int:
        """Number of rollouts that wait for a lease."""
        state = self.state
        records = state.awaited.values()
        awaited = sum(record.count for record in records if record.phase is not DispatchPhase.DONE)
        return len(state.queues) + state.batches.coming + awaited

    @property
    def expected(self) -> frozenset[str]:
        """Workers of a former manager that have not reported, while the dispatcher waits for them."""
        return frozenset(self.state.expected_workers or ()) if self.state.awaited else frozenset()

    @property
    def scenes(self) -> frozenset[str]:
        """Scenes of rollouts without an outcome."""
        return frozenset().union(*(batch.open_scenes for batch in self.state.batches))

    def counters(self, run_id: str) -> RunCounters:
        return self.state.runs.of(run_id).counters

    def pending_of(self, run_id: str) -> int:
        """Return the number of the run's rollouts without an outcome."""
        return sum(batch.whole.left for batch in self.state.batches.of_run(run_id))

    def waiting_scenes_of(self, run_id: str) -> frozenset[str]:
        """Return the scenes of the run's rollouts without an outcome."""
        return frozenset().union(*(batch.open_scenes for batch in self.state.batches.of_run(run_id)))
