"""State of each worker as the manager decides by it, and the pool of live workers."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from embomatrix.manager.control.dispatch.fair_share import SlotTimes
from embomatrix.manager.control.dispatch.records import LeaseRecord, RolloutRecord
from embomatrix.manager.control.events import DrainChanged, SuspicionChanged, WorkerReported
from embomatrix.rpc.wire.bounds import HELD_LEASES
from embomatrix.rpc.wire.values import Resources

AHEAD_S: Final = 0.2
"""Work that a worker may hold beyond its running rollouts, so that slots stay busy while messages are batched."""
BEHIND: Final = 64
"""Most leases queued behind one slot."""
PACE_WEIGHT: Final = 0.1
"""Weight of the latest rollout in the moving average of execution times."""
BEGINS_S: Final = 0.1
LATE_S: Final = 0.2
"""Leases queued behind a busy slot are not stolen from BEGINS_S before to LATE_S after their predicted start: the slot's
process has them by then, and their results may be on the way."""

LAG_WEIGHT: Final = 0.2
"""Weight of the latest lease in the moving average of log slowdowns: one slow lease does not mark a worker as slow."""
LAG_PLAIN: Final = math.log(2.5)
"""Smallest log slowdown that marks a worker as slow: smaller ones follow from its claimed speed or from chance."""
LONGEST_PENALTY_S: Final = 10.0

VICTIMS: Final = 8
SEEKERS: Final = 64
CANDIDATES: Final = 64
"""Most busy workers, idle workers and holders of a scene examined at once, in rotation: large clusters cost no more."""


Standing = WorkerReported | SuspicionChanged | DrainChanged
"""Events that change whether a worker may take leases and scenes."""


@dataclass(slots=True, eq=False)
class WorkerRecord:
    """A worker's resources, standing, leases and speed. The dispatcher writes it, the scheduler reads it."""

    worker_id: str
    resources: Resources

    reported: bool = False
    suspect: bool = False
    """Heartbeats are missing."""
    drained: bool = False
    """An operator drains it."""
    leaving: bool = False
    """It announced that it will leave."""
    paused: str = ""
    """The worker's own reason to take nothing new for now."""
    quarantined: bool = False
    """Audits found wrong results."""
    usable: bool = False
    """True if it may take leases and scenes. Equals ``reported and not withdrawn``."""

    slots: int = field(init=False)
    credits: int = field(init=False)
    """Most leases it may hold: one for each slot, and those that it executes within ``AHEAD_S``, at least one per slot."""
    render_slots: int = field(init=False)
    warm: frozenset[str] = frozenset()
    """Scenes that it may get leases of. Written by ``WorkerPool.set_warm`` only."""
    held: dict[str, LeaseRecord] = field(default_factory=dict)
    """Leases in order of grant; the first ``slots`` run, the others are queued behind them."""
    rendering: int = 0
    """Number of leases in ``held`` that render; at most ``render_slots``."""
    log_lag: float = 0.0
    """Moving average of log slowdowns against other workers."""
    penalty_s: float = 0.0
    """Placement penalty of a slow worker: it takes only rollouts that have waited this long."""
    unconfirmed: int = 0
    """Its results in open audit cases."""
    most_unconfirmed: int | None = None
    """Most leases and unconfirmed results together while it is on probation; None for no limit."""
    completed: int = 0
    pace_s: float = 0.0
    """Moving average of execution times."""

    def __post_init__(self) -> None:
        self.slots = max(self.resources.slots, 1)
        self.credits = 2 * self.slots
        self.render_slots = min(self.resources.render_slots, self.slots)

    def apply(self, event: Standing) -> None:
        """Take over what the event says about the worker's standing. `WorkerPool.update_standing` must follow."""
        match event:
            case WorkerReported():
                self.reported, self.leaving, self.paused = True, event.draining, event.paused
            case DrainChanged():
                self.drained = event.drained
            case SuspicionChanged():
                self.suspect = event.suspect

    @property
    def draining(self) -> bool:
        return self.drained or self.leaving

    @property
    def withdrawn(self) -> bool:
        """True if it may take nothing new, even once it has reported."""
        return bool(self.draining or self.suspect or self.paused or self.quarantined)

    @property
    def open_credits(self) -> int:
        # Nothing is queued behind the slots of a slow worker.
        most = self.credits if self.log_lag < LAG_PLAIN else self.slots
        return most - len(self.held) if self.usable else 0

    @property
    def free_slots(self) -> int:
        return self.slots - len(self.held) if self.usable else 0

    @property
    def busyness(self) -> float:
        """Share of slots that are taken; slow workers come after all others."""
        return len(self.held) / self.slots + self.lag - 1.0

    @property
    def lag(self) -> float:
        """Slowdown against other workers, by its latest leases; 1 unless it is plain."""
        return math.exp(self.log_lag) if self.log_lag >= LAG_PLAIN else 1.0

    def note_completed(self, execute_s: float) -> None:
        """Adapt the pace, and with it the number of leases that it may hold, to a completed execution."""
        weight = PACE_WEIGHT if self.completed else 1.0
        self.completed += 1
        self.pace_s += weight * (execute_s - self.pace_s)
        behind = math.ceil(AHEAD_S / self.pace_s) if self.pace_s * BEHIND > AHEAD_S else BEHIND
        self.credits = min(self.slots * (1 + behind), HELD_LEASES)

    def begins_soon(self, now_s: float) -> bool:
        """True if one of the slots is predicted to start the last lease, queued behind it, now: see ``BEGINS_S``."""
        wait_s = self.pace_s * math.ceil(len(self.held) / self.slots - 1)
        running = islice(self.held.values(), self.slots)
        starts_s = (lease.started_s + wait_s for lease in running if lease.started_s is not None)
        return self.completed > 0 and any(-LATE_S < start_s - now_s < BEGINS_S for start_s in starts_s)

    def avoids(self, record: RolloutRecord, now_s: float) -> bool:
        """True while the rollout's last failure on this worker is too recent."""
        return record.failed_on == self.worker_id and now_s < record.avoid_until_s

    def takes(self, record: RolloutRecord, now_s: float) -> bool:
        """True if the rollout may run here, apart from credits and the scene."""
        if record.failed_on == self.worker_id and now_s < record.avoid_until_s:
            return False
        if now_s - record.submitted_s < self.penalty_s:
            return False
        # Checks are exempt from the limit: newcomers that have reached it confirm each other.
        most = None if record.check else self.most_unconfirmed
        if most is not None and len(self.held) + self.unconfirmed >= most:
            return False
        queue = record.queue
        if queue.render and self.rendering >= self.render_slots:
            return False
        if self.worker_id in queue.excluded_workers:
            return False
        return not record.leases or all(lease.worker_id != self.worker_id for lease in record.leases)


class WorkerPool:
    """Live workers by id, with indices by warm scene, by backlog and by free slots."""

    def __init__(self) -> None:
        self.workers: dict[str, WorkerRecord] = {}
        self.lags: dict[str, float] = {}
        """Slowdown of each slow worker."""
        self._warm_on: dict[str, dict[str, None]] = {}
        """Mirrors ``WorkerRecord.warm``; no empty entries."""
        self._backlogged: dict[str, None] = {}
        """Workers with more leases than slots."""
        self._idle: dict[str, None] = {}
        """Workers with ``free_slots > 0``."""
        self._live: set[str] = set()
        """Workers that could take work now or once they have reported."""

    def join(self, worker_id: str, resources: Resources) -> WorkerRecord:
        """Add a worker. It can take nothing until it has reported."""
        record = self.workers[worker_id] = WorkerRecord(worker_id, resources)
        self._live.add(worker_id)
        return record

    def leave(self, worker_id: str) -> None:
        worker = self.workers.get(worker_id)
        if worker is not None:
            self.set_warm(worker, ())
            del self.workers[worker_id]
            self._backlogged.pop(worker_id, None)
            self._idle.pop(worker_id, None)
            self._live.discard(worker_id)
            self.lags.pop(worker_id, None)

    def update_standing(self, worker: WorkerRecord) -> None:
        """Bring ``usable`` and the indices up to date with a changed standing."""
        worker.usable = worker.reported and not worker.withdrawn
        if worker.withdrawn:
            self._live.discard(worker.worker_id)
        else:
            self._live.add(worker.worker_id)
        self._reindex(worker)

    def set_warm(self, worker: WorkerRecord, scenes: Iterable[str]) -> None:
        """Replace the scenes that the worker holds warm."""
        warm = frozenset(scenes)
        for scene in worker.warm - warm:
            del self._warm_on[scene][worker.worker_id]
            if not self._warm_on[scene]:
                del self._warm_on[scene]
        for scene in warm - worker.warm:
            self._warm_on.setdefault(scene, {})[worker.worker_id] = None
        worker.warm = warm

    def has_warm(self, scene: str) -> bool:
        return scene in self._warm_on

    def add_lease(self, worker: WorkerRecord, lease: LeaseRecord) -> None:
        worker.held[lease.ref.lease_id] = lease
        worker.rendering += lease.record.rollout.render
        if len(worker.held) <= worker.slots:
            lease.started_s = lease.given_s
        self._reindex(worker)

    def remove_lease(self, lease: LeaseRecord, now_s: float) -> None:
        worker = self.workers.get(lease.worker_id)
        if worker is None or worker.held.pop(lease.ref.lease_id, None) is None:
            return
        worker.rendering -= lease.record.rollout.render
        if lease.started_s is not None and len(worker.held) >= worker.slots:
            # The slot goes to the first lease queued behind it.
            next(islice(worker.held.values(), worker.slots - 1, None)).started_s = now_s
        self._reindex(worker)

    def note_slot_time(self, lease: LeaseRecord, times: SlotTimes, now_s: float, *, lost: bool) -> None:
        """Update the worker's slowdown and the run's slot times by a lease that ends now.

        A lease ``lost`` against the hedged one would have taken longer: it counts only if it shows a slower worker.
        """
        if lease.started_s is None:
            return
        took_s, worker = now_s - lease.started_s, self.workers[lease.worker_id]
        usual_s = times.quantile_s(0.5)
        if usual_s and (not lost or took_s > worker.lag * usual_s):
            worker.log_lag += LAG_WEIGHT * (math.log(max(took_s / usual_s, 1e-3)) - worker.log_lag)
            if worker.lag > 1.0:
                worker.penalty_s = min((worker.lag - 1.0) * usual_s, LONGEST_PENALTY_S)
                self.lags[worker.worker_id] = worker.lag
                self._reindex(worker)
            elif worker.worker_id in self.lags:
                worker.penalty_s = 0.0
                del self.lags[worker.worker_id]
                self._reindex(worker)
        if not lost:
            # Slot time on a worker of usual speed.
            times.add(took_s / worker.lag)

    def clear_lags(self) -> list[str]:
        """Treat no worker as slow any more; return those that were."""
        cleared = list(self.lags)
        for worker_id in cleared:
            worker = self.workers[worker_id]
            worker.log_lag = worker.penalty_s = 0.0
            del self.lags[worker_id]
            self._reindex(worker)
        return cleared

    def least_busy(self, scene: str, fits: Callable[[WorkerRecord], bool]) -> WorkerRecord | None:
        """Return the least busy worker with the scene warm that fits; the id breaks ties.

        Of more than ``CANDIDATES`` holders it is the best of some, and None only if no holder fits.
        """
        holders = self._warm_on.get(scene, {})
        if len(holders) <= CANDIDATES:
            free = [worker for name in holders if fits(worker := self.workers[name])]
            return min(free, key=lambda worker: (worker.busyness, worker.worker_id), default=None)
        examined: list[str] = []
        best: WorkerRecord | None = None
        for worker_id in holders:
            if best is not None and len(examined) >= CANDIDATES:
                break
            examined.append(worker_id)
            worker = self.workers[worker_id]
            if fits(worker) and (best is None or worker.busyness < best.busyness):
                best = worker
        _move_to_end(holders, examined)
        return best

    def stealable_lease(self, thief: WorkerRecord, before_s: float, now_s: float) -> LeaseRecord | None:
        """Return a lease granted before ``before_s`` and queued behind a busy slot that the thief may take.

        A lease that is about to start is left alone: it would run twice.
        """
        for worker_id in islice(self._backlogged, VICTIMS):
            victim = self.workers[worker_id]
            lease = next(reversed(victim.held.values()))
            if (
                worker_id != thief.worker_id
                and lease.record.scene in thief.warm
                and lease.given_s <= before_s
                and thief.takes(lease.record, now_s)
                and not victim.begins_soon(now_s)
            ):
                return lease
        return None

    @property
    def idle(self) -> frozenset[str]:
        """Ids of workers with a free slot."""
        return frozenset(self._idle)

    @property
    def has_backlog(self) -> bool:
        """True if a lease is queued behind a busy slot."""
        return bool(self._backlogged)

    def rotate_idle(self) -> list[str]:
        """Return some workers with a free slot, different ones each time."""
        some = list(islice(self._idle, SEEKERS))
        _move_to_end(self._idle, some)
        _move_to_end(self._backlogged, list(islice(self._backlogged, VICTIMS)))
        return some

    @property
    def live_count(self) -> int:
        """Number of workers that are neither draining nor paused, suspected or quarantined."""
        return len(self._live)

    def check_invariants(self) -> None:
        """Raise AssertionError if an index disagrees with the workers."""
        for worker_id, worker in self.workers.items():
            assert worker.usable == (worker.reported and not worker.withdrawn), worker_id
            assert all(lease.worker_id == worker_id for lease in worker.held.values()), worker_id
            assert worker.rendering == sum(lease.record.rollout.render for lease in worker.held.values())
            assert (worker_id in self._idle) == (worker.free_slots > 0), worker_id
            assert (worker_id in self._backlogged) == (len(worker.held) > worker.slots), worker_id
        warm = {(scene, name) for scene, names in self._warm_on.items() for name in names}
        assert warm == {(scene, name) for name, worker in self.workers.items() for scene in worker.warm}
        assert self._live | self._idle.keys() | self._backlogged.keys() | self.lags.keys() <= set(
            self.workers
        )

    def _reindex(self, worker: WorkerRecord) -> None:
        name = worker.worker_id
        if len(worker.held) > worker.slots:
            self._backlogged.setdefault(name)
        else:
            self._backlogged.pop(name, None)
        if worker.free_slots > 0:
            self._idle.setdefault(name)
        else:
            self._idle.pop(name, None)


def _move_to_end(order: dict[str, None], names: Iterable[str]) -> None:
    for name in names:
        del order[name]
        order[name] = None
