"""Interceptor that parses the messages of every call within their bounds.

gRPC itself answers undecodable bytes with a traceback in the log; here they are a malformed message like any other.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import grpc
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.message import Message

from embomatrix.rpc.status import translate
from embomatrix.rpc.wire.bounds import parsed


class BoundsInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[misc]  # grpc is untyped
    """Refuses messages that are malformed or out of bounds with ``INVALID_ARGUMENT``."""

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> grpc.RpcMethodHandler:
        handler = await continuation(handler_call_details)
        if handler is None or handler.request_deserializer is None:
            return handler
        method = handler_call_details.method
        return _bounded(handler, _request_type(method))


def _request_type(method: str) -> type[Message]:
    found = descriptor_pool.Default().FindMethodByName(method.lstrip("/").replace("/", "."))
    return message_factory.GetMessageClass(found.input_type)


def _bounded(handler: grpc.RpcMethodHandler, request_type: type[Message]) -> grpc.RpcMethodHandler:
    """Return the handler with its own parser of requests."""

    async def unary_unary(data: bytes, context: grpc.aio.ServicerContext) -> Any:
        async with translate(context):
            return await handler.unary_unary(parsed(request_type, data), context)

    async def unary_stream(data: bytes, context: grpc.aio.ServicerContext) -> AsyncIterator[Any]:
        async with translate(context):
            async for answer in handler.unary_stream(parsed(request_type, data), context):
                yield answer

    async def stream_unary(requests: AsyncIterator[bytes], context: grpc.aio.ServicerContext) -> Any:
        return await handler.stream_unary(_each_parsed(request_type, requests), context)

    async def stream_stream(requests: AsyncIterator[bytes], context: grpc.aio.ServicerContext) -> Any:
        return await handler.stream_stream(_each_parsed(request_type, requests), context)

    serializer = handler.response_serializer
    if handler.request_streaming and handler.response_streaming:
        return grpc.stream_stream_rpc_method_handler(stream_stream, None, serializer)
    if handler.request_streaming:
        return grpc.stream_unary_rpc_method_handler(stream_unary, None, serializer)
    if handler.response_streaming:
        return grpc.unary_stream_rpc_method_handler(unary_stream, None, serializer)
    return grpc.unary_unary_rpc_method_handler(unary_unary, None, serializer)


async def _each_parsed(request_type: type[Message], requests: AsyncIterator[bytes]) -> AsyncIterator[Message]:
    """Parse the messages of a stream. ConvertError ends it inside the servicer's method, which translates it."""
    async for data in requests:
        yield parsed(request_type, data)
