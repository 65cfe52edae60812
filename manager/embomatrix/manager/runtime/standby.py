"""What a manager serves while another one leads: it refuses every call, and names the leader."""

from __future__ import annotations

from typing import TYPE_CHECKING

import grpc
from fastapi import FastAPI
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from embomatrix.manager.runtime.listen import bind_server
from embomatrix.manager.services.refusal import refusing
from embomatrix.rpc.channel import SERVER_OPTIONS
from embomatrix.rpc.status import StandbyError

if TYPE_CHECKING:
    from embomatrix.manager.access.protection import Tls


class Standby:
    """``leader`` is the address of the manager that leads; set it whenever that changes."""

    def __init__(self, tls: Tls | None = None) -> None:
        self._tls = tls
        self.leader = ""

    @property
    def sentence(self) -> str:
        return f"this manager stands by, the one at {self.leader} leads: pass both to --manager, as in A:PORT,B:PORT"

    async def serve_calls(self, host: str, port: int) -> grpc.aio.Server:
        """A server that runs, with health ``NOT_SERVING``. Raises PortInUseError."""
        server = grpc.aio.server(options=SERVER_OPTIONS)
        servicer = health.aio.HealthServicer()
        health_pb2_grpc.add_HealthServicer_to_server(servicer, server)
        await servicer.set("", health_pb2.HealthCheckResponse.NOT_SERVING)
        server.add_generic_rpc_handlers((_Refusal(self),))
        bind_server(server, host, port, self._tls)
        await server.start()
        return server

    def page(self) -> FastAPI:
        """The status page meanwhile. The manager is healthy: it does what it should."""
        app = FastAPI(title="EmboMatrix manager", docs_url=None, redoc_url=None, openapi_url=None)

        @app.get("/")
        async def page() -> dict[str, str]:
            return {"status": "standing by", "leader": self.leader}

        @app.get("/healthz")
        async def health_check() -> dict[str, str]:
            return {"status": "standing by"}

        return app


class _Refusal(grpc.GenericRpcHandler):  # type: ignore[misc]  # grpc is untyped
    """Answers every method of every service."""

    def __init__(self, standby: Standby) -> None:
        self._standby = standby

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        if handler_call_details.method.startswith("/grpc.health."):
            return None
        refusal = StandbyError(self._standby.sentence, self._standby.leader)
        return refusing(handler_call_details.method, refusal)
