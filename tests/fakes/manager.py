"""Manager for the worker's tests: grants scripted leases, records results and breaks connections on request."""

import asyncio
import contextlib
from dataclasses import dataclass, field

import grpc
from tests.fakes.leases import lease_to_proto

from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.proto.v1 import worker_service_pb2_grpc
from embomatrix.rpc.channel import SERVER_OPTIONS, chunks_of
from embomatrix.rpc.status import (
    NotFoundError,
    SessionLostError,
    SupersededError,
    UnavailableError,
    translate,
)
from embomatrix.rpc.wire.bounds import parsed
from embomatrix.rpc.wire.leases import Lease, LeaseRef
from embomatrix.rpc.wire.session import (
    lease_ref_to_proto,
    lease_result_from_proto,
    resources_from_proto,
    worker_state_from_proto,
)
from embomatrix.rpc.wire.values import Rollout
from embomatrix.world.inflation import bundle_digest


@dataclass
class FakeManager(worker_service_pb2_grpc.WorkerServiceServicer):
    """Manager of one worker.

    ``results`` keeps every received result, ``states`` every full state. ``deliveries`` counts the messages with
    results.
    """

    acknowledging: bool = True
    answering_heartbeats: bool = True
    lease_ttl_s: float = 5.0
    bundles: dict[str, bytes] = field(default_factory=dict)
    damaged: set[str] = field(default_factory=set)
    registrations: list[pb.RegisterRequest] = field(default_factory=list)
    resources: object = None
    states: list = field(default_factory=list)
    results: list = field(default_factory=list)
    deliveries: int = 0
    renewed: list = field(default_factory=list)
    steps: dict = field(default_factory=dict)
    fetches: list[str] = field(default_factory=list)
    epoch: int = 0
    back_s: float = 0.0
    ended: SupersededError = field(
        default_factory=lambda: SupersededError("this session is not known: register again")
    )
    breaking: bool = False
    """The next fetch breaks the connection in its middle, for a second."""
    outgoing: asyncio.Queue = field(default_factory=asyncio.Queue)

    def bundle(self, content):
        digest = bundle_digest(content)
        self.bundles[digest] = content
        return digest

    def want(self, *digests):
        self.outgoing.put_nowait(pb.SessionResponse(desired=pb.DesiredResidents(bundle_digests=digests)))

    def lease(self, lease_id, digest, task="ok", *, deadline_s=10.0):
        lease = Lease(LeaseRef(lease_id, self.epoch), Rollout(lease_id, "g", digest, task, (), 1), deadline_s)
        self.outgoing.put_nowait(pb.SessionResponse(leases=[lease_to_proto(lease)]))
        return lease.ref

    def leases(self, count, digest, task="ok"):
        """Send several leases in one message."""
        rollouts = (Rollout(f"l{number}", "g", digest, task, (), 1) for number in range(count))
        leases = (Lease(LeaseRef(one.rollout_id, self.epoch), one, 60.0) for one in rollouts)
        self.outgoing.put_nowait(pb.SessionResponse(leases=list(map(lease_to_proto, leases))))

    def cancel(self, ref):
        self.outgoing.put_nowait(pb.SessionResponse(cancelled=[lease_ref_to_proto(ref)]))

    def acknowledge(self, ref):
        self.outgoing.put_nowait(pb.SessionResponse(acknowledged=[lease_ref_to_proto(ref)]))

    def drain(self):
        self.outgoing.put_nowait(pb.SessionResponse(drain=True))

    def resume(self):
        self.outgoing.put_nowait(pb.SessionResponse(resume=True))

    def break_stream(self, away_s=0.0):
        """End the session, and accept no other for some seconds."""
        self.back_s = asyncio.get_running_loop().time() + away_s
        self.outgoing.put_nowait(None)

    def forget_session(self):
        self.epoch += 1
        self.outgoing.put_nowait(None)

    def lose_session(self):
        """Forget the session because of its worker's silence."""
        self.ended = SessionLostError("worker w is lost (its connection broke): register again")
        self.forget_session()

    def _check(self, message):
        if asyncio.get_running_loop().time() < self.back_s:
            raise UnavailableError("the manager is away")
        if message.session_epoch != self.epoch:
            raise self.ended

    async def Register(self, request, context):
        async with translate(context):
            self.epoch += 1
            self.registrations.append(request)
            self.resources = resources_from_proto(request.resources)
            return pb.RegisterResponse(
                session_id=f"s{self.epoch}",
                session_epoch=self.epoch,
                heartbeat_interval_s=0.1,
                lease_ttl_s=self.lease_ttl_s,
            )

    async def Heartbeat(self, request, context):
        async with translate(context):
            self._check(request)
            if not self.answering_heartbeats:
                await asyncio.sleep(60)
            self.renewed.append([ref.lease_id for ref in request.running])
            for reported in request.progress:
                self.steps.setdefault(reported.ref.lease_id, []).append(reported.steps)
            return pb.HeartbeatResponse(next_interval_s=0.1)

    async def Session(self, request_iterator, context):
        async with translate(context):
            first = await anext(aiter(request_iterator))
            self._check(first)
            self._take(first)
            reading = asyncio.create_task(self._read(request_iterator))
            try:
                yield pb.SessionResponse()
                while (response := await self._next(reading)) is not None:
                    yield response
            finally:
                reading.cancel()

    async def _next(self, reading):
        getting = asyncio.create_task(self.outgoing.get())
        await asyncio.wait((getting, reading), return_when=asyncio.FIRST_COMPLETED)
        if getting.done():
            return getting.result()
        getting.cancel()
        return None

    async def _read(self, requests):
        async for request in requests:
            self._take(request)

    def _take(self, request):
        parsed(pb.SessionRequest, request.SerializeToString())  # its bounds, as in a real manager
        found = list(request.results)
        self.deliveries += bool(found)
        if request.HasField("state"):
            self.states.append(worker_state_from_proto(request.state))
            found += request.state.finished
        for result in map(lease_result_from_proto, found):
            self.results.append(result)
            if self.acknowledging:
                self.acknowledge(result.ref)

    async def FetchBundle(self, request, context):
        async with translate(context):
            self.fetches.append(request.bundle_digest)
            if request.bundle_digest not in self.bundles:
                raise NotFoundError(f"there is no bundle {request.bundle_digest}")
            data = self.bundles[request.bundle_digest]
            if request.bundle_digest in self.damaged:
                self.damaged.discard(request.bundle_digest)
                data = b"damaged" + data
            for chunk in chunks_of(data):
                yield pb.FetchBundleResponse(chunk=chunk)
                if self.breaking:
                    self.breaking = False
                    self.break_stream(away_s=1.0)
                    await asyncio.sleep(60)


@contextlib.asynccontextmanager
async def serving(manager, port=0):
    """Serve the fake on the loopback interface; yields HOST:PORT."""
    server = grpc.aio.server(options=SERVER_OPTIONS)
    worker_service_pb2_grpc.add_WorkerServiceServicer_to_server(manager, server)
    port = server.add_insecure_port(f"127.0.0.1:{port}")
    await server.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        await server.stop(None)
