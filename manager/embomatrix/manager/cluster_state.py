"""Scheduler and dispatcher as one state machine: the dispatcher's demand feeds the scheduler, its answers feed back."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from embomatrix.manager.assignments import DispatchLimits
from embomatrix.manager.dispatcher import Dispatcher
from embomatrix.manager.events import LeaseFinished, LeasesRenewed, RunClosed, ScenesUnplaceable
from embomatrix.manager.scheduler import ScheduleLimits, Scheduler

if TYPE_CHECKING:
    from embomatrix.manager.commands import Command
    from embomatrix.manager.events import Event
    from embomatrix.rpc.values import RunStats


class ClusterState:
    """Everything that the manager decides. Events in, commands out, the clock an argument, no I/O.

    ``boot_id`` is new for every process of the manager.
    """

    def __init__(
        self,
        dispatch: DispatchLimits | None = None,
        schedule: ScheduleLimits | None = None,
        *,
        boot_id: str,
    ) -> None:
        self.dispatcher = Dispatcher(dispatch or DispatchLimits(), boot_id=boot_id)
        self.scheduler = Scheduler(schedule or ScheduleLimits())
        self._waiting = 0
        self._unplaceable: dict[str, str] = {}

    def handle(self, event: Event, *, now_s: float) -> list[Command]:
        """Take in one fact; returns what shall be done about it, in order."""
        if isinstance(event, LeasesRenewed):
            return self.dispatcher.handle(event, now_s=now_s)
        if isinstance(event, LeaseFinished):
            commands = self.dispatcher.handle(event, now_s=now_s)
            # The hot path: residents are looked at again only when a scene has nobody waiting for it any more.
            if self.dispatcher.waiting_scenes != self._waiting:
                commands += self._reschedule(now_s)
            return commands
        commands = self.scheduler.handle(event, now_s=now_s)
        commands += self.dispatcher.handle(event, now_s=now_s)
        return commands + self._reschedule(now_s)

    def close_run(self, run_id: str, *, now_s: float) -> tuple[RunStats, list[Command]]:
        """End a run: its final counters, and the commands that call off what was open."""
        commands = self.handle(RunClosed(run_id), now_s=now_s)
        self.scheduler.prewarm.close(run_id)
        stats = self.stats(run_id)
        self.scheduler.prewarm.forget(run_id)
        self.dispatcher.forget_run(run_id)
        return stats, commands

    def stats(self, run_id: str) -> RunStats:
        """The counters of an open run."""
        prewarm = self.scheduler.prewarm.counters(run_id)
        return dataclasses.replace(
            self.dispatcher.counters(run_id).stats(),
            prewarm_hits=prewarm.hits,
            prewarm_misses=prewarm.misses,
            prewarm_wasted=prewarm.wasted,
        )

    def _reschedule(self, now_s: float) -> list[Command]:
        self._waiting = self.dispatcher.waiting_scenes
        commands = self.scheduler.handle(self.dispatcher.demand(), now_s=now_s)
        if self.scheduler.unplaceable != self._unplaceable:
            self._unplaceable = dict(self.scheduler.unplaceable)
            commands += self.dispatcher.handle(ScenesUnplaceable(self._unplaceable), now_s=now_s)
        return commands
