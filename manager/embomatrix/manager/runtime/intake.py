"""Input of worker messages and clock ticks: passes them to registry and state machines, and returns commands.

Free of I/O. The services call it with messages and the real clock, the simulator with simulated ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.commands import ManagerCommand
from embomatrix.manager.control.events import (
    Event,
    LeaseFinished,
    LeasesRenewed,
    Tick,
    WorkerLost,
    WorkerReported,
)
from embomatrix.rpc.wire.leases import LeaseProgress, LeaseRef, LeaseResult, WorkerState
from embomatrix.rpc.wire.values import HostUse, Resources

if TYPE_CHECKING:
    from embomatrix.manager.control.cluster_state import ClusterState
    from embomatrix.manager.runtime.registry import Registry, WorkerSession


TICK_S: Final = 0.1
"""Interval of clock ticks to the state machines."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Heartbeat of a worker: the leases it holds, the progress of the running ones, its load, the use of its machine, and
    new lines of its log.
    """

    held: tuple[LeaseRef, ...]
    load: float = 0.0
    memory_mb: int = 0
    progress: tuple[LeaseProgress, ...] = ()
    host: HostUse | None = None
    log_lines: tuple[str, ...] = ()


class Intake:
    """Free of I/O. ``now_s`` is seconds of one monotonic clock. Calls of an ended session raise SupersededError."""

    def __init__(self, cluster: ClusterState, registry: Registry) -> None:
        self.cluster = cluster
        self.registry = registry

    def register(
        self,
        worker_id: str,
        boot_id: str,
        resources: Resources,
        *,
        now_s: float,
    ) -> tuple[WorkerSession, list[ManagerCommand]]:
        """Open a session for a worker."""
        session, events = self.registry.register(worker_id, boot_id, resources, now_s=now_s)
        return session, self.cluster.handle(*events, now_s=now_s)

    def report(
        self,
        session: WorkerSession,
        state: WorkerState | None,
        results: Sequence[LeaseResult],
        *,
        resync: bool,
        now_s: float,
    ) -> list[ManagerCommand]:
        """Process a worker's message; ``resync`` marks the first message of a stream."""
        session = self.registry.find(session.session_id, session.epoch)
        finished = (*(state.finished if state is not None else ()), *results)
        events: list[Event] = self.registry.heard(session, now_s=now_s)
        events += [LeaseFinished(session.worker_id, result.ref, result.outcome) for result in finished]
        if state is not None:
            self.registry.note_state(session, draining=state.draining, paused=state.paused)
            held = (*state.running, *(result.ref for result in state.finished))
            reported = WorkerReported(
                session.worker_id, state.residents, held, state.draining, resync, state.claims, state.paused
            )
            # The first state precedes its results: leases given on the strength of those results were not in it yet.
            events.insert(0 if resync else len(events), reported)
        return self.cluster.handle(*events, now_s=now_s)

    def heartbeat(
        self, session_id: str, epoch: int, beat: Heartbeat, *, now_s: float
    ) -> tuple[float, list[ManagerCommand]]:
        """Renew the leases that the worker names. Return the seconds until the next heartbeat, and commands."""
        session = self.registry.find(session_id, epoch)
        session.load, session.memory_used_mb = beat.load, beat.memory_mb
        events = self.registry.heard(session, now_s=now_s)
        renewed = LeasesRenewed(session.worker_id, beat.held, beat.progress)
        commands = self.cluster.handle(*events, renewed, now_s=now_s)
        return self.registry.interval_s, commands

    def tick(self, *, now_s: float) -> tuple[list[WorkerLost], list[ManagerCommand]]:
        """Process the passage of time. Return lost workers and commands."""
        events = self.registry.tick(now_s=now_s)
        lost = [event for event in events if isinstance(event, WorkerLost)]
        return lost, self.cluster.handle(*events, Tick(), now_s=now_s)
