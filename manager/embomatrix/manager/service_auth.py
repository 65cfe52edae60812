"""One shared token, checked on every call but the health check."""

from __future__ import annotations

import hmac
from typing import TYPE_CHECKING, Any, Final

import grpc

from embomatrix.rpc.channel import TOKEN_KEY, bearer
from embomatrix.rpc.status import ERROR_KEY

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

_OPEN: Final = "/grpc.health.v1.Health/"
_REFUSAL: Final = (
    "no token, or a wrong one: pass --token, or set EMBOMATRIX_TOKEN to the token of this manager"
)


def token_fits(header: str | None, token: str) -> bool:
    """Whether an ``authorization`` header carries the token; takes the same time whatever is wrong with it."""
    return hmac.compare_digest((header or "").encode(), bearer(token).encode())


class TokenInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[misc]  # grpc is untyped
    """Refuses calls without the token as ``UNAUTHENTICATED``."""

    def __init__(self, token: str) -> None:
        self._token = token

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> grpc.RpcMethodHandler:
        handler = await continuation(handler_call_details)
        if handler is None or handler_call_details.method.startswith(_OPEN):
            return handler
        metadata = dict(handler_call_details.invocation_metadata or ())
        if token_fits(metadata.get(TOKEN_KEY), self._token):
            return handler
        return _refusing(handler)


def _refusing(handler: grpc.RpcMethodHandler) -> grpc.RpcMethodHandler:
    """A handler of the same kind that refuses: gRPC answers a unary method's caller only through a unary handler."""

    async def refuse(_: Any, context: grpc.aio.ServicerContext) -> None:
        await context.abort(grpc.StatusCode.UNAUTHENTICATED, _REFUSAL, trailing_metadata=((ERROR_KEY, "1"),))

    makers = {
        (False, False): grpc.unary_unary_rpc_method_handler,
        (False, True): grpc.unary_stream_rpc_method_handler,
        (True, False): grpc.stream_unary_rpc_method_handler,
        (True, True): grpc.stream_stream_rpc_method_handler,
    }
    make = makers[handler.request_streaming, handler.response_streaming]
    return make(refuse, handler.request_deserializer, handler.response_serializer)
