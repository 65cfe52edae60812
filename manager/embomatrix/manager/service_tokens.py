"""The part of AdminService that hands tokens out and takes them back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.proto.v1 import admin_service_pb2_grpc
from embomatrix.rpc.status import NotSignedInError, translate
from embomatrix.rpc.token_client import role_from_proto, token_info_to_proto

if TYPE_CHECKING:
    import grpc

    from embomatrix.manager.access.gate import Gate
    from embomatrix.manager.runtime import ManagerRuntime


class TokenMethods(admin_service_pb2_grpc.AdminServiceServicer):
    def __init__(self, runtime: ManagerRuntime, gate: Gate) -> None:
        self._sessions = runtime
        self._gate = gate

    async def IssueToken(
        self, request: pb.IssueTokenRequest, context: grpc.aio.ServicerContext
    ) -> pb.IssueTokenResponse:
        async with translate(context):
            role = role_from_proto(request.role)
            token, token_id = await self._gate.issue(role, valid_s=request.valid_s, label=request.label)
        return pb.IssueTokenResponse(token=token, token_id=token_id)

    async def ListTokens(
        self, request: pb.ListTokensRequest, context: grpc.aio.ServicerContext
    ) -> pb.ListTokensResponse:
        async with translate(context):
            tokens = [token_info_to_proto(info) for info in self._gate.infos()]
        return pb.ListTokensResponse(tokens=tokens)

    async def RevokeToken(
        self, request: pb.RevokeTokenRequest, context: grpc.aio.ServicerContext
    ) -> pb.RevokeTokenResponse:
        async with translate(context):
            await self._gate.revoke(request.token_id)
            for session in list(self._sessions.registry.sessions.values()):
                if session.credential_id == request.token_id:
                    self._end(session.worker_id, "by the operator")
        return pb.RevokeTokenResponse()

    async def RevokeWorker(
        self, request: pb.RevokeWorkerRequest, context: grpc.aio.ServicerContext
    ) -> pb.RevokeWorkerResponse:
        async with translate(context):
            reason = request.reason[:200] or "by the operator"
            await self._gate.revoke_worker(request.worker_id, reason)
            self._end(request.worker_id, reason)
        return pb.RevokeWorkerResponse()

    def _end(self, worker_id: str, reason: str) -> None:
        session = self._sessions.registry.sessions.get(worker_id)
        if session is not None:
            refused = NotSignedInError(
                f"worker {worker_id} was revoked ({reason}): ask the operator for a new token to join"
            )
            self._sessions.end_session(session, "its credential was revoked", refused)
