"""Outbox of one worker: commands that wait for its stream."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.commands import AcknowledgeLease, CancelLease, GiveLease, SetDesired
from embomatrix.rpc.wire.leases import Lease, LeaseRef

if TYPE_CHECKING:
    from embomatrix.manager.runtime.registry import WorkerSession
    from embomatrix.rpc.status import ClusterError

ACKNOWLEDGE_S: Final = 0.02
"""Longest time that an acknowledgement waits for other commands."""
WorkerCommand = SetDesired | GiveLease | CancelLease | AcknowledgeLease


@dataclass(slots=True)
class OutgoingMessage:
    """One message to a worker. ``desired`` is None if it did not change."""

    desired: tuple[str, ...] | None = None
    leases: list[Lease] = field(default_factory=list)
    acknowledged: list[LeaseRef] = field(default_factory=list)
    cancelled: list[LeaseRef] = field(default_factory=list)
    drain: bool = False
    resume: bool = False

    def add(self, command: WorkerCommand) -> None:
        """Add a command. A later desired set replaces an earlier one."""
        match command:
            case SetDesired(_, scenes):
                self.desired = scenes
            case GiveLease():
                self.leases.append(
                    Lease(command.ref, command.rollout, command.deadline_s, command.origin, command.reward)
                )
            case CancelLease(_, ref):
                self.cancelled.append(ref)
            case AcknowledgeLease(_, ref):
                self.acknowledged.append(ref)


class WorkerLink:
    """Open session stream. The worker's credits bound its outbox."""

    def __init__(self, session: WorkerSession) -> None:
        self.session = session
        self._outbox = OutgoingMessage()
        self._ready = asyncio.Event()
        self._later: asyncio.TimerHandle | None = None
        """Timer for acknowledgements that no other command takes along."""
        self._closed: ClusterError | None = None

    def put(self, command: WorkerCommand) -> None:
        match command:
            case SetDesired():
                self.session.allowed_bundles.update(command.bundle_digests)
            case GiveLease():
                self.session.allowed_bundles.add(command.rollout.bundle_digest)
        self._outbox.add(command)
        if isinstance(command, AcknowledgeLease):
            # A message costs more than what it carries, and no worker waits for this one.
            if self._later is None:
                self._later = asyncio.get_running_loop().call_later(ACKNOWLEDGE_S, self._ready.set)
        else:
            self._ready.set()

    def drain(self) -> None:
        self._outbox.drain, self._outbox.resume = True, False
        self._ready.set()

    def resume(self) -> None:
        """Cancel a drain."""
        self._outbox.drain, self._outbox.resume = False, True
        self._ready.set()

    def close(self, reason: ClusterError) -> None:
        """End the stream: a waiting ``take`` raises the reason."""
        self._closed = reason
        self._ready.set()

    async def take(self) -> OutgoingMessage:
        """Wait for commands and return them. Raises the reason when the stream is closed."""
        await self._ready.wait()
        if self._closed is not None:
            raise self._closed
        self._ready.clear()
        if self._later is not None:
            self._later.cancel()
            self._later = None
        outbox, self._outbox = self._outbox, OutgoingMessage()
        return outbox
