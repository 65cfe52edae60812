"""The way to one worker: what waits to be said to it, gathered until its stream can take it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.commands import AcknowledgeLease, CancelLease, GiveLease, SetDesired
from embomatrix.rpc.wire.leases import Lease

if TYPE_CHECKING:
    from embomatrix.manager.runtime.registry import WorkerSession
    from embomatrix.rpc.status import ClusterError
    from embomatrix.rpc.wire.leases import LeaseRef

ACKNOWLEDGE_S: Final = 0.2
"""An acknowledgement waits for this long for something else to say: the worker only forgets a result with it. While work goes
on, the next leases come sooner, and a message less is a wake-up less at both ends."""

WorkerCommand = SetDesired | GiveLease | CancelLease | AcknowledgeLease


@dataclass(slots=True)
class OutgoingMessage:
    """One message to a worker. ``desired`` is None when it did not change."""

    desired: tuple[str, ...] | None = None
    leases: list[Lease] = field(default_factory=list)
    acknowledged: list[LeaseRef] = field(default_factory=list)
    cancelled: list[LeaseRef] = field(default_factory=list)
    drain: bool = False
    resume: bool = False


class WorkerLink:
    """An open session stream. Its outbox is bounded by the worker's credits; a later desired set replaces an earlier."""

    def __init__(self, session: WorkerSession) -> None:
        self.session = session
        self._outbox = OutgoingMessage()
        self._ready = asyncio.Event()
        self._later: asyncio.TimerHandle | None = None
        self._closed: ClusterError | None = None

    def put(self, command: WorkerCommand) -> None:
        match command:
            case SetDesired():
                self.session.asked.update(command.bundle_digests)
                self._outbox.desired = command.bundle_digests
            case GiveLease():
                self.session.asked.add(command.rollout.bundle_digest)
                self._outbox.leases.append(
                    Lease(command.ref, command.rollout, command.deadline_s, command.origin, command.reward)
                )
            case CancelLease():
                self._outbox.cancelled.append(command.ref)
            case AcknowledgeLease():
                self._outbox.acknowledged.append(command.ref)
                if self._later is None:
                    self._later = asyncio.get_running_loop().call_later(ACKNOWLEDGE_S, self._ready.set)
                return
        self._ready.set()

    def drain(self) -> None:
        self._outbox.drain, self._outbox.resume = True, False
        self._ready.set()

    def resume(self) -> None:
        """Take a drain back."""
        self._outbox.drain, self._outbox.resume = False, True
        self._ready.set()

    def close(self, reason: ClusterError) -> None:
        """The stream must end; whoever waits in ``take`` gets the reason."""
        self._closed = reason
        self._ready.set()

    async def take(self) -> OutgoingMessage:
        """Waits until there is something to say; the wait ends with the stream."""
        await self._ready.wait()
        if self._closed is not None:
            raise self._closed
        self._ready.clear()
        if self._later is not None:
            self._later.cancel()
            self._later = None
        outbox, self._outbox = self._outbox, OutgoingMessage()
        return outbox
