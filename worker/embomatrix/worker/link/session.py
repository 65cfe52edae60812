"""One registration with the manager: its session stream, its heartbeats, and the bundles fetched with it."""

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import AsyncGenerator
from dataclasses import dataclass, field
from typing import Final

import grpc

from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.logs import LogTail
from embomatrix.rpc.status import ClusterError, DeadlineError, NotFoundError, UnavailableError, cluster_errors
from embomatrix.rpc.versions import SPOKEN
from embomatrix.rpc.wire.bounds import LOG_LINES
from embomatrix.rpc.wire.codec import each
from embomatrix.rpc.wire.leases import LeaseClaim, LeaseRef, WorkerState
from embomatrix.rpc.wire.session import (
    host_use_to_proto,
    lease_from_proto,
    lease_progress_to_proto,
    lease_ref_from_proto,
    lease_ref_to_proto,
    resources_to_proto,
    worker_state_to_proto,
    write_lease_result,
)
from embomatrix.rpc.wire.values import InfraCode, Resources
from embomatrix.worker.host.machine import HostMeter
from embomatrix.worker.link.membership import Membership
from embomatrix.worker.link.outbox import ResultOutbox
from embomatrix.worker.slots.pool import SlotPool
from embomatrix.worker.slots.residents import LoadError
from embomatrix.world.inflation import DEFAULT_LIMITS

logger = logging.getLogger(__name__)

REGISTER_S: Final = 10.0
HEARTBEAT_S: Final = 2.0
FETCH_S: Final = 30.0
BROKEN: Final = "the connection to the manager broke"
"""Limits for the answers to a registration, a heartbeat and a request for a bundle."""
HEARTBEATS_MISSED: Final = 3
"""Consecutive unanswered heartbeats after which the connection counts as dead."""
RESULTS_PER_MESSAGE: Final = 256
LINGER_S: Final = 0.09
"""Shortest interval between result messages while every slot has enough leases ahead; a message costs more than its results."""
SPACING_S: Final = 0.003
"""Shortest interval while slots run short of leases."""
AWAITED_SPACING_S: Final = 0.001
"""Shortest interval before results that a client waits for."""
AWAITED_BUSY_S: Final = 0.006
"""The same while every slot has enough leases ahead: then the queue takes several times as long."""


@dataclass(frozen=True, slots=True)
class Registration:
    """Identity of this worker at the manager, and the intervals that the manager asked for."""

    session_id: str
    epoch: int
    heartbeat_s: float
    lease_ttl_s: float
    credential: str = field(default="", repr=False)
    """Credential to use from now on; empty if it does not change."""


async def register(membership: Membership, *, boot_id: str, resources: Resources) -> Registration:
    """Register this worker; an older session of the same worker id ends. Raise ClusterError."""
    request = pb.RegisterRequest(
        worker_id=membership.name,
        boot_id=boot_id,
        protocol_version=SPOKEN.newest,
        protocol_low=SPOKEN.oldest,
        resources=resources_to_proto(resources),
        join_token=membership.token if membership.joining else "",
    )
    shown = "" if membership.joining else membership.token
    async with open_channel(membership.manager, shown, membership.ca) as channel:
        stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
        with cluster_errors(membership.manager):
            answer: pb.RegisterResponse = await stub.Register(request, timeout=REGISTER_S)
    return Registration(
        answer.session_id,
        answer.session_epoch,
        answer.heartbeat_interval_s,
        answer.lease_ttl_s,
        answer.credential,
    )


class ManagerSession:
    """Streams of one connection. ``serve`` raises ClusterError, or returns once the worker has drained."""

    def __init__(
        self,
        membership: Membership,
        registration: Registration,
        pool: SlotPool,
        outbox: ResultOutbox,
        *,
        meter: HostMeter,
        log_tail: LogTail | None,
        renewed_s: float,
    ) -> None:
        self._meter = meter
        self._log_tail = log_tail
        """Log lines for the manager; None: its operators see none."""
        self._lines_sent = 0
        """Number of the last line that the manager acknowledged in this session."""
        self._membership = membership
        self._address = membership.manager
        self._registration = registration
        self._pool = pool
        self._outbox = outbox
        self._leaving = False
        self._drain_requested = False
        self._paused = ""
        self._state_due = False
        self._resync_due = False
        self._due = asyncio.Event()
        self._lingering: asyncio.TimerHandle | None = None
        self._sent_s = -math.inf
        """Time of the last message with results, on the loop's clock."""
        self._data_channel: grpc.aio.Channel | None = None
        self.attached = asyncio.Event()
        """Set after the first message of the manager."""
        self.is_over = False
        """True once ``serve`` has ended: this session fetches nothing any more."""
        self.renewed_s = renewed_s
        """Time of the last renewal of the leases, in this session or an earlier one."""

    def notify(self) -> None:
        """Send results: now, or with others when the next message is due."""
        self._send_at(self._sent_s + (LINGER_S if self._pool.is_saturated else SPACING_S))

    def notify_awaited(self) -> None:
        """Send results that a client waits for."""
        self._send_at(self._sent_s + (AWAITED_BUSY_S if self._pool.is_saturated else AWAITED_SPACING_S))

    def _send_at(self, due_s: float) -> None:
        loop = asyncio.get_running_loop()
        if due_s <= loop.time():
            self._due.set()
        elif self._lingering is None or self._lingering.when() > due_s:
            self._stop_lingering()
            self._lingering = loop.call_at(due_s, self._due.set)

    def notify_state(self) -> None:
        """Send the state, because residents changed."""
        self._state_due = True
        self._due.set()

    def drain(self) -> None:
        """Accept no new leases; the session ends once all held ones are finished and acknowledged."""
        self._leaving = True
        self.notify_state()

    def pause(self, reason: str) -> None:
        """Request no new leases and keep the scenes, for this reason; an empty reason ends the pause."""
        self._paused = reason
        self.notify_state()

    def resync(self) -> None:
        """Reopen the stream: its first message lists the held leases, so that others get the dropped ones."""
        self._resync_due = True
        self._due.set()

    @property
    def _draining(self) -> bool:
        return self._leaving or self._drain_requested

    async def serve(self) -> None:
        """Keep the session until the connection breaks, the manager ends it, or the worker has drained."""
        async with (
            self._open_channel() as channel,
            # A separate connection, so that no bundle delays a heartbeat.
            self._open_channel() as heartbeat_channel,
        ):
            self._data_channel = channel
            heartbeats = asyncio.create_task(self._beat(heartbeat_channel))
            stream = asyncio.create_task(self._stream(channel))
            try:
                done, _ = await asyncio.wait((heartbeats, stream), return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
            finally:
                self.is_over, self._data_channel = True, None
                self._stop_lingering()
                for task in (heartbeats, stream):
                    task.cancel()
                    with contextlib.suppress(asyncio.CancelledError, Exception):
                        await task

    async def leave(self) -> None:
        """Deregister, so that the manager does not wait for this worker; errors are ignored."""
        request = pb.DeregisterRequest(
            session_id=self._registration.session_id, session_epoch=self._registration.epoch
        )
        async with self._open_channel() as channel:
            stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
            with contextlib.suppress(ClusterError), cluster_errors(self._address):
                await stub.Deregister(request, timeout=HEARTBEAT_S)

    def _open_channel(self) -> grpc.aio.Channel:
        return open_channel(self._address, self._membership.token, self._membership.ca)

    async def fetch(self, digest: str) -> bytes:
        """Fetch a bundle's bytes from the manager. Raise LoadError, or ClusterError or TimeoutError if the connection broke."""
        async with asyncio.timeout(FETCH_S):
            await self.attached.wait()
        if self._data_channel is None:
            raise UnavailableError(BROKEN)
        stub = worker_service_pb2_grpc.WorkerServiceStub(self._data_channel)
        request = pb.FetchBundleRequest(session_id=self._registration.session_id, bundle_digest=digest)
        data = bytearray()
        try:
            with cluster_errors(self._address):
                async for response in stub.FetchBundle(request, timeout=FETCH_S):
                    data += response.chunk
                    if len(data) > DEFAULT_LIMITS.compressed_bytes:
                        text = f"the bundle has more than {DEFAULT_LIMITS.compressed_bytes} bytes"
                        raise LoadError(InfraCode.BUNDLE_CORRUPT, text)
        except NotFoundError as error:
            raise LoadError(InfraCode.SCENE_LOAD_FAILED, str(error)) from error
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if task is None or task.cancelling():
                raise
            # gRPC cancels the calls of a channel that is closed, not the task that waits for them.
            raise UnavailableError(BROKEN) from None
        return bytes(data)

    async def _stream(self, channel: grpc.aio.Channel) -> None:
        stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
        self._resync_due = True
        with cluster_errors(self._address):
            while self._resync_due:
                self._resync_due = False
                async for response in stub.Session(self._requests()):
                    if not self.attached.is_set():
                        # The manager answers after the full state, which renews the leases that it lists.
                        self.renewed_s = time.monotonic()
                        self.attached.set()
                    self._handle(response)
        if not self._drained():
            raise UnavailableError(f"the manager at {self._address} ended the session")

    async def _requests(self) -> AsyncGenerator[pb.SessionRequest]:
        """Yield the full state first, then results as they come, and the state after each change.

        Kept results follow the first state, since all of them may not fit into its message.
        """
        self._outbox.begin_stream()
        yield self._request(self._state((*self._pool.claims(), *self._outbox.claims())))
        if self._outbox.has_unsent:
            self._due.set()
        while not self._drained() and not self._resync_due:
            await self._due.wait()
            self._due.clear()
            self._stop_lingering()
            while not self._resync_due and (self._state_due or self._outbox.has_unsent):
                results = self._outbox.take_unsent(RESULTS_PER_MESSAGE)
                message = self._request(self._state() if self._state_due else None)
                for result in results:
                    write_lease_result(result, message.results.add())
                if results:
                    self._sent_s = asyncio.get_running_loop().time()
                self._state_due = False
                yield message

    def _stop_lingering(self) -> None:
        if self._lingering is not None:
            self._lingering.cancel()
            self._lingering = None

    def _state(self, claims: tuple[LeaseClaim, ...] = ()) -> WorkerState:
        return WorkerState(
            self._pool.residents(),
            self._unfinished(),
            draining=self._draining,
            paused=self._paused,
            claims=claims,
        )

    def _unfinished(self) -> tuple[LeaseRef, ...]:
        """Leases whose results the manager does not have."""
        return (*self._pool.held(), *self._outbox.unsent())

    def _request(self, state: WorkerState | None) -> pb.SessionRequest:
        return pb.SessionRequest(
            session_id=self._registration.session_id,
            session_epoch=self._registration.epoch,
            state=None if state is None else worker_state_to_proto(state),
        )

    def _drained(self) -> bool:
        return self._draining and not self._pool.held() and not len(self._outbox)

    def _handle(self, response: pb.SessionResponse) -> None:
        if response.drain != response.resume and response.drain != self._drain_requested:
            logger.info(
                "the manager %s", "asks this worker to drain" if response.drain else "cancels the drain"
            )
            self._drain_requested = response.drain
            self.notify_state()
        if response.HasField("desired"):
            self._pool.want(response.desired.bundle_digests)
        for ref in each("acknowledged", lease_ref_from_proto, response.acknowledged):
            self._outbox.acknowledge(ref)
        cancelled = each("cancelled", lease_ref_from_proto, response.cancelled)
        if cancelled:
            self._pool.cancel(cancelled)
        for ref in cancelled:
            self._outbox.acknowledge(ref)
        for lease in each("leases", lease_from_proto, response.leases):
            self._pool.submit(lease)
        if self._outbox.has_unsent:
            self.notify()
        if self._drained():
            self._due.set()

    async def _beat(self, channel: grpc.aio.Channel) -> None:
        stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
        interval_s = self._registration.heartbeat_s
        missed = 0
        while True:
            await asyncio.sleep(interval_s)
            use = self._meter.use()
            lines, last = self._log_tail.lines(self._lines_sent, LOG_LINES) if self._log_tail else ((), 0)
            request = pb.HeartbeatRequest(
                session_id=self._registration.session_id,
                session_epoch=self._registration.epoch,
                running=[lease_ref_to_proto(ref) for ref in self._unfinished()],
                load=self._pool.load,
                memory_used_mb=int(self._pool.memory_used_mb),
                progress=[lease_progress_to_proto(progress) for progress in self._pool.progress()],
                host=None if use is None else host_use_to_proto(use),
                log_lines=lines,
            )
            try:
                with cluster_errors(self._address):
                    answer = await stub.Heartbeat(request, timeout=HEARTBEAT_S)
            except (DeadlineError, UnavailableError):
                missed += 1
                if missed >= HEARTBEATS_MISSED:
                    raise
                continue
            missed = 0
            self._lines_sent = last
            self.renewed_s = time.monotonic()
            interval_s = answer.next_interval_s or self._registration.heartbeat_s
