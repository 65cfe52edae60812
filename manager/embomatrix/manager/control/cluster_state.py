"""Scheduler and dispatcher as one state machine: the dispatcher's demand feeds the scheduler, its answers feed back."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.commands import QuarantineWorker
from embomatrix.manager.control.dispatch.assignments import DispatchLimits
from embomatrix.manager.control.dispatch.dispatcher import Dispatcher
from embomatrix.manager.control.events import RunClosed, ScenesUnplaceable, WorkerJoined, WorkerQuarantined
from embomatrix.manager.control.schedule.scheduler import ScheduleLimits, Scheduler, Urgency
from embomatrix.rpc.wire.values import RunStats

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.manager.control.commands import Command
    from embomatrix.manager.control.events import Event

EFFORT_S: Final = 1e-5
"""What a placement is taken to cost for each need and worker that it looks at: what it costs sets how often it is made."""
LATER_S: Final = 0.02
LATER_SHARE: Final = 0.02
"""Between placements that can wait there is at least this, and they take at most this share of the time."""
NOW_SHARE: Final = 0.1
"""The same of those that can't."""


class ClusterState:
    """Everything that the manager decides. Events in, commands out, the clock an argument, no I/O.

    ``boot_id`` is new for every process of the manager; the epochs of its leases begin with ``first_epoch``.
    ``audit_key`` is a secret of it.
    """

    def __init__(
        self,
        dispatch: DispatchLimits | None = None,
        schedule: ScheduleLimits | None = None,
        *,
        boot_id: str,
        first_epoch: int = 1,
        audit_key: bytes = b"",
    ) -> None:
        self.dispatcher = Dispatcher(
            dispatch or DispatchLimits(), boot_id=boot_id, first_epoch=first_epoch, audit_key=audit_key
        )
        self.scheduler = Scheduler(schedule or ScheduleLimits())
        self._waiting = 0
        self._placed_s = -math.inf
        self._urgency = Urgency.NONE
        self._closed = RunStats()
        self._unplaceable: dict[str, str] = {}

    def handle(self, *events: Event, now_s: float) -> list[Command]:
        """Take in facts of one moment; returns what shall be done about them, in order."""
        commands = self.dispatcher.handle(*events, now_s=now_s)
        urgency = max((self.scheduler.note(event, now_s=now_s) for event in events), default=Urgency.NONE)
        barred = [command.worker_id for command in commands if isinstance(command, QuarantineWorker)]
        joined = (event.worker_id for event in events if isinstance(event, WorkerJoined))
        barred += filter(self.dispatcher.auditor.quarantined, joined)
        for worker_id in barred:
            urgency = max(urgency, self.scheduler.note(WorkerQuarantined(worker_id), now_s=now_s))
        if self.dispatcher.waiting_scenes != self._waiting:
            # A scene got its first waiting rollout, or lost its last.
            urgency = max(urgency, Urgency.LATER)
        self._urgency = max(urgency, self._urgency)
        if self._urgency and now_s - self._placed_s >= self._pause_s():
            commands += self._place(now_s)
        return commands

    def close_run(self, run_id: str, *, now_s: float) -> tuple[RunStats, list[Command]]:
        """End a run: its final counters, and the commands that call off what was open."""
        commands = self.handle(RunClosed(run_id), now_s=now_s)
        self.scheduler.prewarm.close(run_id)
        stats = self.stats(run_id)
        self._closed = _sum([self._closed, stats])
        self.scheduler.prewarm.forget(run_id)
        self.dispatcher.forget_run(run_id)
        return stats, commands

    def needed_scenes(self) -> frozenset[str]:
        """Scenes of rollouts without an outcome, and of what is announced: their bundles must stay."""
        windows = self.scheduler.windows.values()
        announced = frozenset(entry.bundle_digest for window in windows for entry in window.entries)
        return self.dispatcher.scenes | announced

    def stats(self, run_id: str) -> RunStats:
        """The counters of an open run."""
        prewarm = self.scheduler.prewarm.counters(run_id)
        return dataclasses.replace(
            self.dispatcher.counters(run_id).stats(),
            prewarm_hits=prewarm.hits,
            prewarm_misses=prewarm.misses,
            prewarm_wasted=prewarm.wasted,
        )

    def waits_for(self, run_id: str) -> str:
        """Why rollouts of the run can't be executed by any worker that is there; empty while they can."""
        reasons = self.scheduler.unplaceable
        scenes = self.dispatcher.waiting_scenes_of(run_id) if reasons else ()
        return next((reasons[scene] for scene in sorted(scenes) if scene in reasons), "")

    def totals(self) -> RunStats:
        """The counters of all runs, also of those that were closed."""
        open_runs = [self.stats(run_id) for run_id in self.dispatcher.runs]
        return _sum([self._closed, *open_runs])

    def _pause_s(self) -> float:
        """How long after the last placement the next one may come. What is left open, a later event or tick decides."""
        cost_s = EFFORT_S * self.scheduler.effort
        return cost_s / NOW_SHARE if self._urgency is Urgency.NOW else max(LATER_S, cost_s / LATER_SHARE)

    def _place(self, now_s: float) -> list[Command]:
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
