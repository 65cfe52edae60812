"""Scheduler and dispatcher as one state machine: the dispatcher's demand feeds the scheduler, whose answers feed back."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

from embomatrix.manager.control.commands import ManagerCommand, QuarantineWorker
from embomatrix.manager.control.dispatch.dispatcher import Dispatcher
from embomatrix.manager.control.dispatch.state import DispatchLimits
from embomatrix.manager.control.events import Event, RunClosed, ScenesUnplaceable
from embomatrix.manager.control.schedule.scheduler import ScheduleLimits, Scheduler, Urgency
from embomatrix.rpc.wire.values import RunStats

UNIT_COST_S: Final = 1e-5
"""Assumed CPU time of a placement for each need and worker that it examines."""
LATER_S: Final = 0.02
LATER_SHARE: Final = 0.02
"""Placements that can wait are at least LATER_S apart and take at most this share of the time."""
NOW_SHARE: Final = 0.1
"""Largest share of the time for urgent placements."""


class ClusterState:
    """All decisions of the manager. Events in, commands out, the clock an argument, no I/O.

    ``lease_key`` and ``audit_key`` are secret, and all managers of a cluster have the same ``lease_key``. Lease epochs
    begin at ``first_epoch``. With ``debug``, the invariants are checked after every event.
    """

    def __init__(
        self,
        dispatch: DispatchLimits | None = None,
        schedule: ScheduleLimits | None = None,
        *,
        lease_key: bytes,
        first_epoch: int = 1,
        audit_key: bytes = b"",
        debug: bool = False,
    ) -> None:
        self.dispatcher = Dispatcher(
            dispatch or DispatchLimits(), lease_key=lease_key, first_epoch=first_epoch, audit_key=audit_key
        )
        self.scheduler = Scheduler(schedule or ScheduleLimits(), self.dispatcher.workers)
        self._debug = debug
        self._waiting = 0
        self._placed_s = -math.inf
        self._urgency = Urgency.NONE
        self._closed = RunStats()
        self._unplaceable: dict[str, str] = {}

    def handle(self, *events: Event, now_s: float) -> list[ManagerCommand]:
        """Apply events of one moment; return the commands in order."""
        commands = self.dispatcher.handle(*events, now_s=now_s)
        urgency = max((self.scheduler.note(event, now_s=now_s) for event in events), default=Urgency.NONE)
        for command in commands:
            if isinstance(command, QuarantineWorker):
                urgency = max(urgency, self.scheduler.standing_changed(command.worker_id))
        if self.dispatcher.waiting_scenes != self._waiting:
            # A scene got its first waiting rollout, or lost its last.
            urgency = max(urgency, Urgency.LATER)
        self._urgency = max(urgency, self._urgency)
        if self._urgency and now_s - self._placed_s >= self._pause_s():
            commands += self._place(now_s)
        if self._debug:
            self.check_invariants()
        return commands

    def close_run(self, run_id: str, *, now_s: float) -> tuple[RunStats, list[ManagerCommand]]:
        """End a run; return its final counters, and the commands that cancel its open batches."""
        commands = self.handle(RunClosed(run_id), now_s=now_s)
        self.scheduler.prewarm.close(run_id)
        stats = self.stats(run_id)
        self._closed = _sum([self._closed, stats])
        self.scheduler.prewarm.forget(run_id)
        self.dispatcher.state.runs.forget(run_id)
        return stats, commands

    def needed_scenes(self) -> frozenset[str]:
        """Return the scenes of open rollouts and of look-ahead windows: their bundles must be kept."""
        windows = self.scheduler.windows.values()
        announced = frozenset(entry.bundle_digest for window in windows for entry in window.entries)
        return self.dispatcher.scenes | announced

    def stats(self, run_id: str) -> RunStats:
        """Return the counters of an open run."""
        prewarm = self.scheduler.prewarm.counters(run_id)
        return dataclasses.replace(
            self.dispatcher.counters(run_id).stats(),
            prewarm_hits=prewarm.hits,
            prewarm_misses=prewarm.misses,
            prewarm_wasted=prewarm.wasted,
        )

    def waits_for(self, run_id: str) -> str:
        """Return why no present worker can execute some rollouts of the run; empty if all can be executed."""
        reasons = self.scheduler.unplaceable
        scenes = self.dispatcher.waiting_scenes_of(run_id) if reasons else ()
        return next((reasons[scene] for scene in sorted(scenes) if scene in reasons), "")

    def totals(self) -> RunStats:
        """Return the summed counters of all runs, closed ones included."""
        open_runs = [self.stats(run_id) for run_id in self.dispatcher.state.runs]
        return _sum([self._closed, *open_runs])

    def check_invariants(self) -> None:
        """Raise AssertionError if parts of the state contradict each other."""
        self.dispatcher.state.check_invariants()
        self.scheduler.check_invariants()

    def _pause_s(self) -> float:
        """Return the shortest time between two placements. A later event or tick makes up for a skipped one."""
        cost_s = UNIT_COST_S * self.scheduler.cost
        return cost_s / NOW_SHARE if self._urgency is Urgency.NOW else max(LATER_S, cost_s / LATER_SHARE)

    def _place(self, now_s: float) -> list[ManagerCommand]:
        self._placed_s, self._urgency = now_s, Urgency.NONE
        self._waiting = self.dispatcher.waiting_scenes
        self.scheduler.note(self.dispatcher.demand(), now_s=now_s)
        commands = self.scheduler.place(now_s=now_s)
        if self.scheduler.unplaceable != self._unplaceable:
            self._unplaceable = dict(self.scheduler.unplaceable)
            commands += self.dispatcher.handle(ScenesUnplaceable(self._unplaceable), now_s=now_s)
        return commands


def _sum(parts: Sequence[RunStats]) -> RunStats:
    return RunStats(*(sum(column) for column in zip(*map(dataclasses.astuple, parts), strict=True)))
