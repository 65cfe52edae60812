"""The part of AdminService that hands tokens out and takes them back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.proto.v1 import admin_service_pb2_grpc
from embomatrix.rpc.status import translate
from embomatrix.rpc.token_client import role_from_proto, token_info_to_proto

if TYPE_CHECKING:
    import grpc

    from embomatrix.manager.access.gate import Gate
    from embomatrix.manager.services.expulsion import Expulsion


class TokenMethods(admin_service_pb2_grpc.AdminServiceServicer):
    def __init__(self, gate: Gate, expulsion: Expulsion) -> None:
        self._gate = gate
        self._expulsion = expulsion

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
            await self._expulsion.revoke_token(request.token_id)
        return pb.RevokeTokenResponse()

    async def RevokeWorker(
        self, request: pb.RevokeWorkerRequest, context: grpc.aio.ServicerContext
    ) -> pb.RevokeWorkerResponse:
        async with translate(context):
            await self._expulsion.revoke_worker(request.worker_id, request.reason[:200] or "by the operator")
        return pb.RevokeWorkerResponse()
