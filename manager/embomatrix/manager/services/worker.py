"""WorkerService: registration, session streams, heartbeats, and bundle downloads of workers."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator, Coroutine
from typing import TYPE_CHECKING, Final

from grpc.aio import ServicerContext as Context

from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.intake import Heartbeat
from embomatrix.manager.runtime.registry import WorkerSession, WorkerStanding
from embomatrix.manager.runtime.worker_link import OutgoingMessage, WorkerLink
from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.rpc.logs import bind
from embomatrix.rpc.status import (
    DeadlineError,
    InvalidRequestError,
    NotAllowedError,
    SupersededError,
    translated,
)
from embomatrix.rpc.versions import SPOKEN, VersionRange, agree
from embomatrix.rpc.wire.codec import each, inside
from embomatrix.rpc.wire.leases import LeaseResult
from embomatrix.rpc.wire.session import (
    host_use_from_proto,
    lease_progress_from_proto,
    lease_ref_from_proto,
    lease_result_from_proto,
    resources_from_proto,
    worker_state_from_proto,
    write_lease,
    write_lease_ref,
)

if TYPE_CHECKING:
    from embomatrix.manager.access.gate import Gate

FIRST_STATE_S: Final = 10.0
"""Time limit for the first state on a session stream."""
SESSION_SHOWN: Final = 6
"""Characters of a session id in log lines. The full id would let a reader speak for the worker."""
LEASES_PER_MESSAGE: Final = 256
RESULTS_AT_ONCE: Final = 16
"""Results processed without a pause. Processing one takes 0.1 ms, so a message of hundreds would delay the leases of
every worker."""
_WORKER_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:@-]{0,127}")


@translated
class WorkerServicer(worker_service_pb2_grpc.WorkerServiceServicer):
    """Workers must stop leases that they could not renew within ``lease_ttl_s``."""

    def __init__(self, runtime: ManagerRuntime, gate: Gate, *, lease_ttl_s: float) -> None:
        self._runtime = runtime
        self._gate = gate
        self._lease_ttl_s = lease_ttl_s

    async def Register(self, request: pb.RegisterRequest, context: Context) -> pb.RegisterResponse:
        _check_name(request.worker_id)
        bind("worker", request.worker_id)
        # Versions are checked first: a refused version must not use up a join token.
        protocol = _agreed(request)
        resources = inside("resources", resources_from_proto, request.resources)
        token_id, credential = await self._gate.admit(
            context, request.join_token, request.worker_id, request.boot_id
        )
        session, interval_s = await self._runtime.register(
            request.worker_id,
            request.boot_id,
            resources,
            credential_id=token_id,
        )
        return pb.RegisterResponse(
            session_id=session.session_id,
            session_epoch=session.epoch,
            heartbeat_interval_s=interval_s,
            lease_ttl_s=self._lease_ttl_s,
            protocol_version=protocol,
            credential=credential,
        )

    async def Session(  # type: ignore[override]  # gRPC also takes a coroutine that writes by the context
        self, request_iterator: AsyncIterator[pb.SessionRequest], context: Context
    ) -> None:
        first = await _first_state(request_iterator)
        session = self._runtime.registry.find(first.session_id, first.session_epoch)
        self._check_session(context, session)
        bind("worker", session.worker_id)
        bind("session", session.session_id[:SESSION_SHOWN])
        with self._runtime.attached(session) as link:
            await self._take(link, first, resync=True)
            await _until_one_ends(self._listen(link, request_iterator), _speak(link, context))

    async def Heartbeat(self, request: pb.HeartbeatRequest, context: Context) -> pb.HeartbeatResponse:
        session = self._runtime.registry.find(request.session_id, request.session_epoch)
        self._check_session(context, session)
        interval_s = self._runtime.process_heartbeat(
            request.session_id,
            request.session_epoch,
            Heartbeat(
                each("running", lease_ref_from_proto, request.running),
                request.load,
                request.memory_used_mb,
                each("progress", lease_progress_from_proto, request.progress),
                inside("host", host_use_from_proto, request.host) if request.HasField("host") else None,
                tuple(request.log_lines),
            ),
        )
        return pb.HeartbeatResponse(next_interval_s=interval_s)

    async def FetchBundle(
        self, request: pb.FetchBundleRequest, context: Context
    ) -> AsyncIterator[pb.FetchBundleResponse]:
        session = self._runtime.registry.find_by_id(request.session_id)
        self._check_session(context, session)
        if request.bundle_digest not in session.allowed_bundles:
            raise NotAllowedError(
                f"worker {session.worker_id} was not asked to hold bundle {request.bundle_digest[:80]!r}"
            )
        async for chunk in self._runtime.bundles.get(request.bundle_digest):
            yield pb.FetchBundleResponse(chunk=chunk)

    async def Deregister(self, request: pb.DeregisterRequest, context: Context) -> pb.DeregisterResponse:
        session = self._runtime.registry.find(request.session_id, request.session_epoch)
        self._check_session(context, session)
        left = SupersededError(f"worker {session.worker_id} has left: its session is over")
        self._runtime.end_session(session, "it left", left, WorkerStanding.LEFT)
        return pb.DeregisterResponse()

    def _check_session(self, context: Context, session: WorkerSession) -> None:
        self._gate.check_session(context, session.worker_id, session.credential_id)

    async def _listen(self, link: WorkerLink, requests: AsyncIterator[pb.SessionRequest]) -> None:
        async for request in requests:
            await self._take(link, request, resync=False)

    async def _take(self, link: WorkerLink, request: pb.SessionRequest, *, resync: bool) -> None:
        state = inside("state", worker_state_from_proto, request.state) if request.HasField("state") else None
        try:
            self._runtime.process_report(link, state, _results(request, 0), resync=resync)
            for first in range(RESULTS_AT_ONCE, len(request.results), RESULTS_AT_ONCE):
                await asyncio.sleep(0)  # lets other coroutines send leases and hear workers
                self._runtime.process_report(link, None, _results(request, first), resync=False)
        finally:
            self._runtime.deliver()


def _results(request: pb.SessionRequest, first: int) -> tuple[LeaseResult, ...]:
    part = request.results[first : first + RESULTS_AT_ONCE]
    return each("results", lease_result_from_proto, part, first=first)


async def _speak(link: WorkerLink, context: Context) -> None:
    while True:
        for message in _messages(await link.take()):
            await context.write(message)


def _messages(outbox: OutgoingMessage) -> list[pb.SessionResponse]:
    """Split the outbox into messages of bounded size, since leases carry plans."""
    messages: list[pb.SessionResponse] = []
    for at in range(0, max(len(outbox.leases), 1), LEASES_PER_MESSAGE):
        messages.append(pb.SessionResponse())
        for lease in outbox.leases[at : at + LEASES_PER_MESSAGE]:
            write_lease(lease, messages[-1].leases.add())
    head = messages[0]
    for ref in outbox.acknowledged:
        write_lease_ref(ref, head.acknowledged.add())
    for ref in outbox.cancelled:
        write_lease_ref(ref, head.cancelled.add())
    head.drain, head.resume = outbox.drain, outbox.resume
    if outbox.desired is not None:
        head.desired.CopyFrom(pb.DesiredResidents(bundle_digests=outbox.desired))
    return messages


async def _first_state(requests: AsyncIterator[pb.SessionRequest]) -> pb.SessionRequest:
    try:
        async with asyncio.timeout(FIRST_STATE_S):
            first = await anext(requests)
    except TimeoutError:
        raise DeadlineError(
            f"a session begins with the worker's state: none came in {FIRST_STATE_S:g} s"
        ) from None
    except StopAsyncIteration:
        raise InvalidRequestError(
            "a session begins with the worker's state: the stream ended before it"
        ) from None
    if not first.HasField("state"):
        raise InvalidRequestError("a session begins with the worker's state: the first message has none")
    return first


async def _until_one_ends(*parts: Coroutine[None, None, None]) -> None:
    """Run the coroutines until the first ends, cancel the others, and raise the first one's error."""
    tasks = [asyncio.create_task(part) for part in parts]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for task in done:
        task.result()


def _check_name(worker_id: str) -> None:
    if not _WORKER_ID.fullmatch(worker_id):
        raise InvalidRequestError(
            f"worker id {worker_id[:140]!r}: use up to 128 letters, digits, '.', '_', ':', '@' and '-'"
        )


def _agreed(request: pb.RegisterRequest) -> int:
    """Return the version that both sides speak. Raises PreconditionError."""
    newest = request.protocol_version
    theirs = VersionRange(request.protocol_low or newest, newest)
    return agree(SPOKEN, theirs, us="this manager", them=f"worker {request.worker_id}")
