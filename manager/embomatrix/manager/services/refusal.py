"""Calls that are refused as a whole: who calls learns why, by whatever kind of method it called."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import grpc
from google.protobuf import descriptor_pool

from embomatrix.rpc.status import translate

if TYPE_CHECKING:
    from embomatrix.rpc.status import ClusterError


def refusing(method: str, refusal: ClusterError) -> grpc.RpcMethodHandler:
    """A handler for ``/package.Service/Method`` that refuses, of the method's own kind.

    gRPC answers a unary method's caller only through a unary handler. It has no deserializer: a stranger's message stays bytes.
    """

    async def refuse(_: Any, context: grpc.aio.ServicerContext) -> None:
        async with translate(context):
            raise refusal

    makers = {
        (False, False): grpc.unary_unary_rpc_method_handler,
        (False, True): grpc.unary_stream_rpc_method_handler,
        (True, False): grpc.stream_unary_rpc_method_handler,
        (True, True): grpc.stream_stream_rpc_method_handler,
    }
    return makers[_streams(method)](refuse)


def _streams(method: str) -> tuple[bool, bool]:
    """Whether requests and answers of the method are streams; taken for both where nobody knows the method."""
    try:
        found = descriptor_pool.Default().FindMethodByName(method.lstrip("/").replace("/", "."))
    except KeyError:
        return True, True
    return found.client_streaming, found.server_streaming
