"""One registration with the manager: the session stream, the heartbeat beside it, and bundles fetched under it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.rpc.channel import open_channel
from embomatrix.rpc.status import (
    ClusterError,
    DeadlineError,
    NotFoundError,
    UnavailableError,
    cluster_errors,
)
from embomatrix.rpc.versions import PROTOCOL_VERSION
from embomatrix.rpc.wire.codec import each
from embomatrix.rpc.wire.leases import WorkerState
from embomatrix.rpc.wire.session import (
    lease_from_proto,
    lease_progress_to_proto,
    lease_ref_from_proto,
    lease_ref_to_proto,
    resources_to_proto,
    worker_state_to_proto,
    write_lease_result,
)
from embomatrix.rpc.wire.values import InfraCode
from embomatrix.worker.slots.residents import LoadError
from embomatrix.world.inflation import DEFAULT_LIMITS

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    import grpc

    from embomatrix.rpc.wire.values import Resources
    from embomatrix.worker.link.membership import Membership
    from embomatrix.worker.link.outbox import ResultOutbox
    from embomatrix.worker.slots.pool import SlotPool

logger = logging.getLogger(__name__)

REGISTER_S: Final = 10.0
HEARTBEAT_S: Final = 2.0
FETCH_S: Final = 30.0
"""Limits for the answers to a registration, a heartbeat and a request for a bundle."""
HEARTBEATS_MISSED: Final = 3
"""So many heartbeats in a row without an answer mean that the connection is dead."""
RESULTS_PER_MESSAGE: Final = 256
LINGER_S: Final = 0.09
"""A message costs more than what it carries: while every slot has enough ahead, there is one in this time at most …"""
SPACING_S: Final = 0.003
"""… and in this time while slots run short: whoever comes first goes at once."""


@dataclass(frozen=True, slots=True)
class Registration:
    """What the manager knows this worker by, and the intervals it asked for."""

    session_id: str
    epoch: int
    heartbeat_s: float
    lease_ttl_s: float
    credential: str = field(default="", repr=False)
    """What this worker shows from here on; empty when that does not change."""


async def register(membership: Membership, *, boot_id: str, resources: Resources) -> Registration:
    """Announce this worker; an older session of the same worker id ends. Raises ClusterError."""
    request = pb.RegisterRequest(
        worker_id=membership.name,
        boot_id=boot_id,
        protocol_version=PROTOCOL_VERSION,
        protocol_low=PROTOCOL_VERSION,
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
    """The streams of one connection. ``serve`` ends with a ClusterError, or without one once the worker has drained."""

    def __init__(
        self,
        membership: Membership,
        registration: Registration,
        pool: SlotPool,
        outbox: ResultOutbox,
        *,
        renewed_s: float,
    ) -> None:
        self._membership = membership
        self._address = membership.manager
        self._registration = registration
        self._pool = pool
        self._outbox = outbox
        self._leaving = False
        self._told_to_drain = False
        self._paused = ""
        self._state_due = False
        self._resync_due = False
        self._news = asyncio.Event()
        self._lingering: asyncio.TimerHandle | None = None
        self._sent_s = -math.inf
        """When results went last, on the loop's clock."""
        self._data_channel: grpc.aio.Channel | None = None
        self.attached = asyncio.Event()
        """Set once the manager was heard on the stream."""
        self.renewed_s = renewed_s
        """When a manager last renewed the leases, in this session or before it."""

    def tell(self) -> None:
        """There are results to send: now, or gathered with others until the next message is due."""
        due_s = self._sent_s + (LINGER_S if self._pool.ahead else SPACING_S)
        loop = asyncio.get_running_loop()
        if due_s <= loop.time():
            self._news.set()
        elif self._lingering is None or self._lingering.when() > due_s:
            self._linger_no_more()
            self._lingering = loop.call_at(due_s, self._news.set)

    def tell_state(self) -> None:
        """Residents changed: the state is due."""
        self._state_due = True
        self._news.set()

    def drain(self) -> None:
        """Take nothing new; the session ends when everything held is finished and acknowledged."""
        self._leaving = True
        self.tell_state()

    def pause(self, reason: str) -> None:
        """Ask for nothing new and keep the scenes, for this reason; an empty one takes that back."""
        self._paused = reason
        self.tell_state()

    def resync(self) -> None:
        """Open the stream anew: its first message tells which leases are held here no longer, so that others get them."""
        self._resync_due = True
        self._news.set()

    @property
    def _draining(self) -> bool:
        return self._leaving or self._told_to_drain

    async def serve(self) -> None:
        """Keep the session until the connection breaks, the manager ends it, or the worker has drained."""
        async with (
            self._open_channel() as channel,
            # Its own connection: no bundle on its way delays a heartbeat.
            self._open_channel() as heartbeat_channel,
        ):
            self._data_channel = channel
            beating = asyncio.create_task(self._beat(heartbeat_channel))
            talking = asyncio.create_task(self._talk(channel))
            try:
                done, _ = await asyncio.wait((beating, talking), return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
            finally:
                self._data_channel = None
                self._linger_no_more()
                for task in (beating, talking):
                    task.cancel()
                    with contextlib.suppress(asyncio.CancelledError, Exception):
                        await task

    async def leave(self) -> None:
        """Say that this worker is gone for good, so that nobody waits for it; a manager that can't hear it will find out."""
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
        """The bundle's bytes as the manager sends them. Raises LoadError."""
        async with asyncio.timeout(FETCH_S):
            await self.attached.wait()
        if self._data_channel is None:
            raise LoadError(InfraCode.SCENE_LOAD_FAILED, "the connection to the manager broke")
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
        return bytes(data)

    async def _talk(self, channel: grpc.aio.Channel) -> None:
        stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
        self._resync_due = True
        with cluster_errors(self._address):
            while self._resync_due:
                self._resync_due = False
                async for response in stub.Session(self._requests()):
                    if not self.attached.is_set():
                        # The manager answers once it has heard the full state, which renews what it names.
                        self.renewed_s = time.monotonic()
                        self.attached.set()
                    self._take(response)
        if not self._drained():
            raise UnavailableError(f"the manager at {self._address} ended the session")

    async def _requests(self) -> AsyncGenerator[pb.SessionRequest]:
        """Full state first; then results as they come, and the state again whenever it changed."""
        self._outbox.begin_stream()
        finished = self._outbox.take_unsent(len(self._outbox))
        claims = (*self._pool.claims(), *self._outbox.claims())
        yield self._request(
            state=WorkerState(
                self._pool.residents(),
                self._pool.held(),
                finished,
                self._draining,
                self._paused,
                claims,
            )
        )
        while not self._drained() and not self._resync_due:
            await self._news.wait()
            self._news.clear()
            self._linger_no_more()
            while not self._resync_due and (self._state_due or self._outbox.has_unsent):
                results = self._outbox.take_unsent(RESULTS_PER_MESSAGE)
                message = self._request(state=self._state() if self._state_due else None)
                for result in results:
                    write_lease_result(result, message.results.add())
                if results:
                    self._sent_s = asyncio.get_running_loop().time()
                self._state_due = False
                yield message

    def _linger_no_more(self) -> None:
        if self._lingering is not None:
            self._lingering.cancel()
            self._lingering = None

    def _state(self) -> WorkerState:
        return WorkerState(self._pool.residents(), self._pool.held(), (), self._draining, self._paused)

    def _request(self, state: WorkerState | None) -> pb.SessionRequest:
        return pb.SessionRequest(
            session_id=self._registration.session_id,
            session_epoch=self._registration.epoch,
            state=None if state is None else worker_state_to_proto(state),
        )

    def _drained(self) -> bool:
        return self._draining and not self._pool.held() and not len(self._outbox)

    def _take(self, response: pb.SessionResponse) -> None:
        if response.drain != response.resume and response.drain != self._told_to_drain:
            logger.info(
                "the manager %s", "asks this worker to drain" if response.drain else "takes its drain back"
            )
            self._told_to_drain = response.drain
            self.tell_state()
        if response.HasField("desired"):
            self._pool.want(response.desired.bundle_digests)
        for ref in each("acknowledged", lease_ref_from_proto, response.acknowledged):
            self._outbox.acknowledge(ref)
        cancelled = each("cancelled", lease_ref_from_proto, response.cancelled)
        self._pool.cancel(cancelled)
        for ref in cancelled:
            self._outbox.acknowledge(ref)
        for lease in each("leases", lease_from_proto, response.leases):
            self._pool.submit(lease)
        if self._outbox.has_unsent:
            self.tell()
        if self._drained():
            self._news.set()

    async def _beat(self, channel: grpc.aio.Channel) -> None:
        stub = worker_service_pb2_grpc.WorkerServiceStub(channel)
        interval_s = self._registration.heartbeat_s
        missed = 0
        while True:
            await asyncio.sleep(interval_s)
            request = pb.HeartbeatRequest(
                session_id=self._registration.session_id,
                session_epoch=self._registration.epoch,
                running=[lease_ref_to_proto(ref) for ref in self._pool.held()],
                load=self._pool.load,
                memory_used_mb=int(self._pool.memory_used_mb),
                progress=[lease_progress_to_proto(progress) for progress in self._pool.progress()],
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
            self.renewed_s = time.monotonic()
            interval_s = answer.next_interval_s or self._registration.heartbeat_s
