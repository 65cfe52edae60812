"""The door of every call: refuses, with a sentence, whoever has no token for it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import grpc

from embomatrix.rpc.channel import TOKEN_KEY
from embomatrix.rpc.status import translate

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from embomatrix.manager.access.gate import Gate
    from embomatrix.rpc.status import ClusterError


class RoleInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[misc]  # grpc is untyped
    """Lets a call through if the gate has nothing against it; what it carries is not parsed before that."""

    def __init__(self, gate: Gate) -> None:
        self._gate = gate

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> grpc.RpcMethodHandler:
        handler = await continuation(handler_call_details)
        if handler is None:
            return handler
        metadata = dict(handler_call_details.invocation_metadata or ())
        refusal = self._gate.refusal(handler_call_details.method, metadata.get(TOKEN_KEY))
        return handler if refusal is None else _refusing(handler, refusal)


def _refusing(handler: grpc.RpcMethodHandler, refusal: ClusterError) -> grpc.RpcMethodHandler:
    """A handler of the same kind that refuses: gRPC answers a unary method's caller only through a unary handler.

    It has no deserializer: the message of a stranger stays bytes.
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
    make = makers[handler.request_streaming, handler.response_streaming]
    return make(refuse, None, handler.response_serializer)
