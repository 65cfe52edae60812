"""gRPC server with all services on one port, health checks, reflection, and access control."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Final

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.revocation import Revocation
from embomatrix.manager.services.admin import AdminServicer
from embomatrix.manager.services.listen import bind_server
from embomatrix.manager.services.messages import BoundsInterceptor
from embomatrix.manager.services.rollout import RolloutServicer
from embomatrix.manager.services.scene import SceneServicer
from embomatrix.manager.services.standby import refusing
from embomatrix.manager.services.worker import WorkerServicer
from embomatrix.proto.v1 import (
    admin_service_pb2_grpc,
    rollout_service_pb2_grpc,
    scene_service_pb2_grpc,
    worker_service_pb2_grpc,
)
from embomatrix.rpc.channel import SERVER_OPTIONS, TOKEN_KEY

if TYPE_CHECKING:
    from embomatrix.manager.access.gate import Gate
    from embomatrix.manager.access.protection import Tls
    from embomatrix.manager.settings import ManagerSettings

SERVICES: Final = tuple(
    f"embomatrix.proto.v1.{name}"
    for name in ("WorkerService", "RolloutService", "SceneService", "AdminService")
)


async def build_server(
    runtime: ManagerRuntime, gate: Gate, tls: Tls | None, settings: ManagerSettings
) -> tuple[grpc.aio.Server, int]:
    """Return a bound server that is not started, and its port.

    Raises PortInUseError.
    """
    server = grpc.aio.server(
        options=SERVER_OPTIONS, interceptors=[RoleInterceptor(gate), BoundsInterceptor()]
    )
    worker_service_pb2_grpc.add_WorkerServiceServicer_to_server(
        WorkerServicer(runtime, gate, lease_ttl_s=settings.lease_ttl_s), server
    )
    rollout_service_pb2_grpc.add_RolloutServiceServicer_to_server(
        RolloutServicer(
            runtime.runs, runtime.turns, runtime.training, gate, authority=tls.authority if tls else b""
        ),
        server,
    )
    scene_service_pb2_grpc.add_SceneServiceServicer_to_server(SceneServicer(runtime.bundles), server)
    admin_service_pb2_grpc.add_AdminServiceServicer_to_server(
        AdminServicer(runtime, gate, Revocation(runtime, gate)), server
    )
    await _add_health(server)
    reflection.enable_server_reflection((*SERVICES, health.SERVICE_NAME, reflection.SERVICE_NAME), server)
    return server, bind_server(server, settings.host, settings.port, tls)


async def _add_health(server: grpc.aio.Server) -> None:
    servicer = health.aio.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(servicer, server)
    for name in ("", *SERVICES):
        await servicer.set(name, health_pb2.HealthCheckResponse.SERVING)


class RoleInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[misc]  # grpc is untyped
    """Rejects calls that the gate refuses, before their messages are parsed."""

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
        method = handler_call_details.method
        headers = [value for key, value in handler_call_details.invocation_metadata or () if key == TOKEN_KEY]
        refusal = self._gate.refusal(method, headers)
        return handler if refusal is None else refusing(refusal)
