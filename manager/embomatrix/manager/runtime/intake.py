"""What workers say and what the clock brings, told to the registry and the state machines: commands come back.

The way in without the wire: the service calls it with messages and its own clock, the simulator with simulated ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.events import (
    Event,
    LeaseFinished,
    LeasesRenewed,
    Tick,
    WorkerLost,
    WorkerReported,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.manager.control.cluster_state import ClusterState
    from embomatrix.manager.control.commands import Command
    from embomatrix.manager.runtime.registry import Registry, WorkerSession
    from embomatrix.rpc.wire.leases import LeaseProgress, LeaseRef, LeaseResult, WorkerState
    from embomatrix.rpc.wire.values import Resources


TICK_S: Final = 0.1
"""The state machines are told of the time this often."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """What a worker says between its reports: the leases that it holds, how far those are that run, and how busy it is."""

    held: tuple[LeaseRef, ...]
    load: float = 0.0
    memory_mb: int = 0
    progress: tuple[LeaseProgress, ...] = ()


class Intake:
    """No I/O. ``now_s`` is seconds of one monotonic clock; calls under a session that ended raise ``SupersededError``."""

    def __init__(self, cluster: ClusterState, registry: Registry) -> None:
        self.cluster = cluster
        self.registry = registry

    def feed(self, *events: Event, now_s: float) -> list[Command]:
        """Tell the state machines of these, in order; what became free is given away after the last of them."""
        return self.cluster.handle(*events, now_s=now_s)

    def register(
        self,
        worker_id: str,
        boot_id: str,
        resources: Resources,
        *,
        now_s: float,
    ) -> tuple[WorkerSession, list[Command]]:
        """Open a session for a worker."""
        session, events = self.registry.register(worker_id, boot_id, resources, now_s=now_s)
        return session, self.feed(*events, now_s=now_s)

    def report(
        self,
        session: WorkerSession,
        state: WorkerState | None,
        results: Sequence[LeaseResult],
        *,
        resync: bool,
        now_s: float,
    ) -> list[Command]:
        """What a worker says on its stream; ``resync`` for the first message of a stream."""
        session = self.registry.find(session.session_id, session.epoch)
        finished = (*(state.finished if state is not None else ()), *results)
        events: list[Event] = self.registry.heard(session, now_s=now_s)
        events += [LeaseFinished(session.worker_id, result.ref, result.outcome) for result in finished]
        if state is not None:
            self.registry.told(session, draining=state.draining, paused=state.paused)
            held = (*state.running, *(result.ref for result in state.finished))
            reported = WorkerReported(
                session.worker_id, state.residents, held, state.draining, resync, state.claims, state.paused
            )
            # A first state comes first: what is leased on the strength of its results was not there when it was written.
            events.insert(0 if resync else len(events), reported)
        return self.feed(*events, now_s=now_s)

    def heartbeat(
        self, session_id: str, epoch: int, beat: Heartbeat, *, now_s: float
    ) -> tuple[float, list[Command]]:
        """Renew the leases that the worker names; returns the seconds until the next heartbeat as well."""
        session = self.registry.find(session_id, epoch)
        session.load, session.memory_used_mb = beat.load, beat.memory_mb
        events = self.registry.heard(session, now_s=now_s)
        renewed = LeasesRenewed(session.worker_id, beat.held, beat.progress)
        commands = self.feed(*events, renewed, now_s=now_s)
        return self.registry.interval_s, commands

    def tick(self, *, now_s: float) -> tuple[list[WorkerLost], list[Command]]:
        """Time has passed: who is lost, and what else is due."""
        events = self.registry.tick(now_s=now_s)
        lost = [event for event in events if isinstance(event, WorkerLost)]
        return lost, self.feed(*events, Tick(), now_s=now_s)
