"""Small manager for the client's tests: keeps one batch's results and breaks its streams on request."""

import contextlib
from dataclasses import dataclass, field

import grpc

from embomatrix.proto.v1 import (
    admin_service_pb2_grpc,
    rollout_service_pb2,
    rollout_service_pb2_grpc,
    scene_service_pb2,
    scene_service_pb2_grpc,
)
from embomatrix.rpc.channel import SERVER_OPTIONS, TOKEN_KEY
from embomatrix.rpc.status import NotFoundError, NotSignedInError, translate
from embomatrix.rpc.versions import PROTOCOL_VERSION
from embomatrix.rpc.wire.outcome import rollout_result_to_proto
from embomatrix.rpc.wire.rollout import batch_from_proto
from embomatrix.rpc.wire.values import Cancelled, RolloutResult


@dataclass
class FakeCluster(
    rollout_service_pb2_grpc.RolloutServiceServicer,
    scene_service_pb2_grpc.SceneServiceServicer,
    admin_service_pb2_grpc.AdminServiceServicer,
):
    """Manager that cancels every rollout at once. A stream ends after ``results_per_stream`` results."""

    results_per_stream: int = 1000
    break_streams: bool = False
    token: str = ""
    forget_after: int | None = None
    bundles: dict[str, bytes] = field(default_factory=dict)
    submissions: int = 0
    attachments: list[int] = field(default_factory=list)
    results: list[RolloutResult] | None = None

    def _check(self, context):
        if self.token and (TOKEN_KEY, f"Bearer {self.token}") not in context.invocation_metadata():
            raise NotSignedInError("no such token: ask the operator for one")

    async def GetCapabilities(self, request, context):
        return rollout_service_pb2.GetCapabilitiesResponse(
            protocol_low=PROTOCOL_VERSION, protocol_high=PROTOCOL_VERSION
        )

    async def OpenRun(self, request, context):
        async with translate(context):
            self._check(context)
            return rollout_service_pb2.OpenRunResponse(run_id=request.run_id or "run-1")

    async def CloseRun(self, request, context):
        async with translate(context):
            raise KeyError("a defect")

    async def Execute(self, request, context):
        async with translate(context):
            self._check(context)
            self.submissions += 1
            batch = batch_from_proto(request)
            self.results = [
                RolloutResult(rollout.rollout_id, rollout.group_id, cursor, 1, Cancelled(), rollout.also)
                for cursor, rollout in enumerate(batch.rollouts, start=1)
            ]
            async for response in self._stream(0, rollout_service_pb2.ExecuteResponse, context):
                yield response

    async def WaitExecution(self, request, context):
        async with translate(context):
            self.attachments.append(request.after_cursor)
            if len(self.attachments) == self.forget_after:
                self.results = None
            if self.results is None:
                raise NotFoundError(f"there is no batch {request.batch_id}: submit it again")
            async for response in self._stream(
                request.after_cursor, rollout_service_pb2.WaitExecutionResponse, context
            ):
                yield response

    async def _stream(self, after, response_type, context):
        due = [result for result in self.results if result.cursor > after]
        for result in due[: self.results_per_stream]:
            yield response_type(results=[rollout_result_to_proto(result)])
        if self.break_streams and len(due) > self.results_per_stream:
            await context.abort(grpc.StatusCode.UNAVAILABLE, "connection reset")

    async def MissingBundles(self, request, context):
        missing = [digest for digest in request.bundle_digests if digest not in self.bundles]
        return scene_service_pb2.MissingBundlesResponse(bundle_digests=missing)

    async def PutBundle(self, request_iterator, context):
        async with translate(context):
            self._check(context)
            digest, data = "", b""
            async for request in request_iterator:
                digest = digest or request.bundle_digest
                assert len(request.chunk) <= 1024 * 1024
                data += request.chunk
            self.bundles[digest] = data
            return scene_service_pb2.PutBundleResponse()


@contextlib.asynccontextmanager
async def serving(cluster):
    """Serve the fake on a free port of the loopback interface; yields HOST:PORT."""
    server = grpc.aio.server(options=SERVER_OPTIONS)
    rollout_service_pb2_grpc.add_RolloutServiceServicer_to_server(cluster, server)
    scene_service_pb2_grpc.add_SceneServiceServicer_to_server(cluster, server)
    admin_service_pb2_grpc.add_AdminServiceServicer_to_server(cluster, server)
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        await server.stop(None)
