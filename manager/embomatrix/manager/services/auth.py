"""The door of every call: refuses, with a sentence, whoever has no token for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import grpc

from embomatrix.manager.services.refusal import refusing
from embomatrix.rpc.channel import TOKEN_KEY

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from embomatrix.manager.access.gate import Gate


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
        method = handler_call_details.method
        refusal = self._gate.refusal(method, metadata.get(TOKEN_KEY))
        return handler if refusal is None else refusing(method, refusal)
