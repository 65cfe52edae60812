"""Server of a standby manager, which refuses every call and names the leader."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import grpc
from fastapi import FastAPI
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from embomatrix.manager.services.listen import bind_server
from embomatrix.rpc.channel import SERVER_OPTIONS
from embomatrix.rpc.status import ClusterError, StandbyError, refuse

if TYPE_CHECKING:
    from embomatrix.manager.access.protection import Tls


class Standby:
    """Standby server. ``leader`` is the address of the current leader."""

    def __init__(self, tls: Tls | None = None) -> None:
        self._tls = tls
        self.leader = ""

    @property
    def sentence(self) -> str:
        return f"this manager stands by, the manager at {self.leader} leads: pass both to --manager, as in A:PORT,B:PORT"

    async def serve_calls(self, host: str, port: int) -> grpc.aio.Server:
        """Return a running server with health ``NOT_SERVING``. Raises PortInUseError."""
        server = grpc.aio.server(options=SERVER_OPTIONS)
        servicer = health.aio.HealthServicer()
        health_pb2_grpc.add_HealthServicer_to_server(servicer, server)
        await servicer.set("", health_pb2.HealthCheckResponse.NOT_SERVING)
        server.add_generic_rpc_handlers((_Refusal(self),))
        bind_server(server, host, port, self._tls)
        await server.start()
        return server

    def page(self) -> FastAPI:
        """Return the HTTP application of a standby. Its health check succeeds."""
        app = FastAPI(title="EmboMatrix manager", docs_url=None, redoc_url=None, openapi_url=None)

        @app.get("/")
        @app.get("/healthz")
        async def page() -> dict[str, str]:
            return {"status": "standing by", "leader": self.leader}

        return app


class _Refusal(grpc.GenericRpcHandler):  # type: ignore[misc]  # grpc is untyped
    """Handler of every method of every service."""

    def __init__(self, standby: Standby) -> None:
        self._standby = standby

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        if handler_call_details.method.startswith("/grpc.health."):
            return None
        refusal = StandbyError(self._standby.sentence, self._standby.leader)
        return refusing(refusal)


def refusing(refusal: ClusterError) -> grpc.RpcMethodHandler:
    """Return a handler that refuses every call without receiving its message."""

    async def answer(_: Any, context: grpc.aio.ServicerContext) -> None:
        refuse(context, refusal)

    return grpc.stream_stream_rpc_method_handler(answer)
