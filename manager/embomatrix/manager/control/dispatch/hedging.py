"""Stragglers: what runs for too long at the end of a group or batch is started once more elsewhere, within a budget."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from embomatrix.manager.control.dispatch.assignments import Assignments, DispatchLimits
    from embomatrix.manager.control.dispatch.ledger import LeaseRecord, RolloutRecord, WorkerRecord

LOOKED_AT: Final = 256
"""Rollouts of tails that are looked at in one go, each time others."""
SLOW: Final = 2.0
"""A lease is late after so many times the 95th percentile of its run's slot times."""


class Hedger:
    """Looks at the tails when the clock says so. ``wanted`` are scenes of stragglers that no idle worker has warm."""

    def __init__(self, desk: Assignments, limits: DispatchLimits) -> None:
        self.wanted: Mapping[str, tuple[int, float]] = {}
        """How many rollouts would go elsewhere, and for how many seconds the first of them has had its lease."""
        self._desk = desk
        self._limits = limits

    def look(self) -> None:
        """Start what is late a second time, where a slot is idle that has its scene."""
        wanted: dict[str, tuple[int, float]] = {}
        desk = self._desk
        if desk.fleet.idle and not desk.paused:
            for lease in self._late():
                record = lease.record
                worker = desk.fleet.best_for(record.scene, self._idle_for(record))
                if worker is None:
                    count, held_s = wanted.get(record.scene, (0, 0.0))
                    wanted[record.scene] = count + 1, max(held_s, desk.now_s - lease.given_s)
                elif lease.started_s is not None:
                    desk.hedge(record, worker)
        self.wanted = wanted

    def _late(self) -> Iterator[LeaseRecord]:
        """The only leases of rollouts that are late and may have a second one."""
        for record in self._tails():
            if len(record.leases) != 1 or record.hedged or record.out_of_memory:
                continue
            (lease,) = record.leases
            since_s = lease.given_s if lease.started_s is None else lease.started_s
            if self._desk.now_s - since_s > self._patience_s(record) and self._has_budget(record):
                yield lease

    def _tails(self) -> list[RolloutRecord]:
        tails = self._desk.batches.tails
        records: list[RolloutRecord] = []
        for group in list(tails):
            if len(records) >= LOOKED_AT:
                break
            records += islice(group.open.values(), LOOKED_AT - len(records))
            del tails[group]
            tails[group] = None
        return list(dict.fromkeys(records))

    def _patience_s(self, record: RolloutRecord) -> float:
        usual_s = self._desk.runs.of(record.key.run_id).times.quantile_s(0.95)
        # Of a run that is not known yet nobody can say what is late.
        return float("inf") if usual_s is None else max(SLOW * usual_s, self._limits.hedge_after_s)

    def _has_budget(self, record: RolloutRecord) -> bool:
        run = self._desk.runs.of(record.key.run_id)
        return run.counters.hedged + 1 <= self._limits.hedge_share * run.submitted

    def _idle_for(self, record: RolloutRecord) -> Callable[[WorkerRecord], bool]:
        now_s = self._desk.now_s

        def idle(worker: WorkerRecord) -> bool:
            return worker.free_slots > 0 and worker.takes(record, now_s)

        return idle
