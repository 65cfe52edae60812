"""The workers as the Task-Dispatcher sees them: what they hold warm, and how much more they can take."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.dispatch.ledger import LeaseRecord, WorkerRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from embomatrix.manager.control.dispatch.run_book import SlotTimes

VICTIMS: Final = 8
SEEKERS: Final = 64
CANDIDATES: Final = 64
"""Busy workers, idle workers and holders of a scene looked at in one go, each time others: bounds, so that a large cluster
costs no more than a small one."""

LONGEST_RELUCTANCE_S: Final = 10.0


def has_credit(worker: WorkerRecord) -> bool:
    """Whether it may be given a lease at all."""
    return worker.open_credits > 0


class Fleet:
    """Live workers by id, with indices by warm scene, by backlog and by free slots."""

    def __init__(self) -> None:
        self.workers: dict[str, WorkerRecord] = {}
        self._warm_on: dict[str, dict[str, None]] = {}
        self._backlogged: dict[str, None] = {}
        self._idle: dict[str, None] = {}
        self._live: set[str] = set()
        self.lags: dict[str, float] = {}
        """How many times slower those workers are that plainly are."""

    def join(
        self,
        worker_id: str,
        slots: int,
        render_slots: int = 0,
        versions: Mapping[str, str] | None = None,
    ) -> WorkerRecord:
        """A new worker, which can take nothing until it has reported."""
        slots = max(slots, 1)
        record = WorkerRecord(
            worker_id,
            slots=slots,
            credits=2 * slots,
            render_slots=min(render_slots, slots),
            versions=versions or {},
        )
        self.workers[worker_id] = record
        self._live.add(worker_id)
        return record

    def leave(self, worker_id: str) -> WorkerRecord | None:
        worker = self.workers.get(worker_id)
        if worker is not None:
            self.set_warm(worker, ())
            del self.workers[worker_id]
            self._backlogged.pop(worker_id, None)
            self._idle.pop(worker_id, None)
            self._live.discard(worker_id)
            self.lags.pop(worker_id, None)
        return worker

    def time(self, lease: LeaseRecord, times: SlotTimes, now_s: float, *, lost: bool) -> None:
        """What a lease took tells how fast its worker is, and how long others of its run may take.

        One that ``lost`` against a second one would have taken longer still.
        """
        if lease.started_s is None:
            return
        took_s, worker = now_s - lease.started_s, self.workers[lease.worker_id]
        usual_s = times.quantile_s(0.5)
        if usual_s and (not lost or took_s > worker.lag * usual_s):
            self._note_lag(worker, took_s, usual_s)
        if not lost:
            # As it would have been on a worker that is not slow.
            times.add(took_s / worker.lag)

    def _note_lag(self, worker: WorkerRecord, took_s: float, usual_s: float) -> None:
        """One of the worker's leases took so long, where those of its run take so long as a rule."""
        worker.note_lag(took_s / usual_s)
        if worker.lag > 1.0:
            worker.reluctance_s = min((worker.lag - 1.0) * usual_s, LONGEST_RELUCTANCE_S)
            self.lags[worker.worker_id] = worker.lag
            self._weigh(worker)
        elif worker.worker_id in self.lags:
            worker.reluctance_s = 0.0
            del self.lags[worker.worker_id]
            self._weigh(worker)

    def stand(self, worker: WorkerRecord) -> None:
        """The worker drains, paused, reported, fell silent or was heard again: it may take leases, or no longer."""
        if worker.draining or worker.suspect or worker.paused or worker.quarantined:
            self._live.discard(worker.worker_id)
        else:
            self._live.add(worker.worker_id)
        self._weigh(worker)

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

    def forgive(self) -> list[str]:
        """Take nobody for slow any more: there is nobody to be slower than. Returns those who may take more now."""
        forgiven = list(self.lags)
        for worker_id in forgiven:
            worker = self.workers[worker_id]
            worker.log_lag = worker.reluctance_s = 0.0
            del self.lags[worker_id]
            self._weigh(worker)
        return forgiven

    def hold(self, worker: WorkerRecord, lease: LeaseRecord) -> None:
        worker.held[lease.ref.lease_id] = lease
        worker.rendering += lease.record.rollout.render
        if len(worker.held) <= worker.slots:
            lease.started_s = lease.given_s
        self._weigh(worker)

    def release(self, lease: LeaseRecord, now_s: float) -> None:
        worker = self.workers.get(lease.worker_id)
        if worker is None or worker.held.pop(lease.ref.lease_id, None) is None:
            return
        worker.rendering -= lease.record.rollout.render
        if lease.started_s is not None and len(worker.held) >= worker.slots:
            # Its slot goes to the first of those that waited behind.
            next(islice(worker.held.values(), worker.slots - 1, None)).started_s = now_s
        self._weigh(worker)

    def best_for(self, scene: str, fits: Callable[[WorkerRecord], bool] = has_credit) -> WorkerRecord | None:
        """The least busy worker with the scene warm that fits; the id breaks ties.

        Where very many hold the scene, the best of some of them; None only if none of all fits.
        """
        holders = self._warm_on.get(scene, {})
        if len(holders) > CANDIDATES:
            return self._good_for(holders, fits)
        free = [worker for name in holders if fits(worker := self.workers[name])]
        return min(free, key=lambda worker: (worker.busyness, worker.worker_id), default=None)

    def _good_for(
        self, holders: dict[str, None], fits: Callable[[WorkerRecord], bool]
    ) -> WorkerRecord | None:
        looked_at: list[str] = []
        best: WorkerRecord | None = None
        for worker_id in holders:
            if best is not None and len(looked_at) >= CANDIDATES:
                break
            looked_at.append(worker_id)
            worker = self.workers[worker_id]
            if fits(worker) and (best is None or worker.busyness < best.busyness):
                best = worker
        _move_to_end(holders, looked_at)
        return best

    def waiting_behind(self, thief: WorkerRecord, before_s: float, now_s: float) -> LeaseRecord | None:
        """A lease, given before that time, that waits behind a busy slot and that the thief, with its scene warm, may take.

        One that is about to begin where it is would be executed twice.
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
    def backlogged(self) -> bool:
        """Whether leases wait behind a busy slot somewhere."""
        return bool(self._backlogged)

    def seekers(self) -> list[str]:
        """Some workers with a free slot, each time others: what was not for them before may be now."""
        some = list(islice(self._idle, SEEKERS))
        _move_to_end(self._idle, some)
        _move_to_end(self._backlogged, list(islice(self._backlogged, VICTIMS)))
        return some

    @property
    def live(self) -> int:
        """How many workers could take work now or soon: neither draining nor paused nor suspected."""
        return len(self._live)

    def _weigh(self, worker: WorkerRecord) -> None:
        """Have the indices by backlog and free slots follow what the worker holds and may take."""
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
