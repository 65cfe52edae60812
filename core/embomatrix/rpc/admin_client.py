"""The operator's side of the cluster: what it plans, and what a person may tell it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.proto.v1 import admin_service_pb2_grpc
from embomatrix.rpc.channel import DEFAULT_ADDRESS, open_channel
from embomatrix.rpc.client import DEFAULT_LIMITS, ClientLimits
from embomatrix.rpc.convert import each
from embomatrix.rpc.convert_session import plan_cell_from_proto, worker_info_from_proto
from embomatrix.rpc.status import cluster_errors

if TYPE_CHECKING:
    from embomatrix.rpc.values import PlanCell, WorkerInfo


class AdminClient:
    """Async context manager over one channel to the manager. Every failure is a ``ClusterError``."""

    def __init__(
        self, address: str = DEFAULT_ADDRESS, token: str = "", *, limits: ClientLimits = DEFAULT_LIMITS
    ) -> None:
        self._address = address
        self._token = token
        self._limits = limits

    async def __aenter__(self) -> Self:
        self._channel = open_channel(self._address, self._token)
        self._admin = admin_service_pb2_grpc.AdminServiceStub(self._channel)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._channel.close()

    async def list_workers(self) -> tuple[WorkerInfo, ...]:
        """The workers that the manager knows."""
        with cluster_errors(self._address):
            answer = await self._admin.ListWorkers(pb.ListWorkersRequest(), timeout=self._limits.call_s)
            return each("workers", worker_info_from_proto, answer.workers)

    async def drain_worker(self, worker_id: str) -> None:
        """Ask a worker to finish what it runs and to leave."""
        with cluster_errors(self._address):
            await self._admin.DrainWorker(
                pb.DrainWorkerRequest(worker_id=worker_id), timeout=self._limits.call_s
            )

    async def resume_worker(self, worker_id: str) -> None:
        """Take a drain back, as long as the worker has not left."""
        with cluster_errors(self._address):
            await self._admin.ResumeWorker(
                pb.ResumeWorkerRequest(worker_id=worker_id), timeout=self._limits.call_s
            )

    async def plan(self, run_id: str = "") -> tuple[PlanCell, ...]:
        """The look-ahead grid of one run, or of all: what each coming step needs, and who has it."""
        with cluster_errors(self._address):
            answer = await self._admin.GetPlan(pb.GetPlanRequest(run_id=run_id), timeout=self._limits.call_s)
            return each("cells", plan_cell_from_proto, answer.cells)

    async def pause_dispatch(self) -> None:
        """Have no new leases given; what runs goes on."""
        with cluster_errors(self._address):
            await self._admin.PauseDispatch(pb.PauseDispatchRequest(), timeout=self._limits.call_s)

    async def resume_dispatch(self) -> None:
        """Have leases given again."""
        with cluster_errors(self._address):
            await self._admin.ResumeDispatch(pb.ResumeDispatchRequest(), timeout=self._limits.call_s)
