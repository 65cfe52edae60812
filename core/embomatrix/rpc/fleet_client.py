"""What trainers, viewers and operators alike ask of a cluster: who works, what runs, and that a worker leave."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.proto.v1 import admin_service_pb2_grpc
from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.leader_client import LeaderClient
from embomatrix.rpc.managers import PATIENCE_S, of_the_leader
from embomatrix.rpc.status import cluster_errors
from embomatrix.rpc.wire.rollout import each
from embomatrix.rpc.wire.session import run_info_from_proto, worker_info_from_proto
from embomatrix.rpc.wire.values import FleetStatus

if TYPE_CHECKING:
    from embomatrix.rpc.wire.values import RunInfo, WorkerInfo

CALL_S: Final = 10.0
"""For the answer to one call."""


class FleetClient(LeaderClient):
    """Async context manager over channels to a cluster. Every failure is a ``ClusterError``."""

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        token: str = "",
        *,
        ca: bytes = b"",
        call_s: float = CALL_S,
        patience_s: float = PATIENCE_S,
    ) -> None:
        super().__init__(address, token, ca=ca, patience_s=patience_s)
        self._call_s = call_s

    @property
    def _admin(self) -> admin_service_pb2_grpc.AdminServiceAsyncStub:
        return admin_service_pb2_grpc.AdminServiceStub(self._channel)

    async def list_workers(self) -> tuple[WorkerInfo, ...]:
        """The workers that the manager knows, also those that it lost a moment ago."""
        return (await self.fleet()).workers

    @of_the_leader
    async def fleet(self) -> FleetStatus:
        """The same, and how the cluster does."""
        with cluster_errors(self._address):
            answer = await self._admin.ListWorkers(pb.ListWorkersRequest(), timeout=self._call_s)
            return FleetStatus(
                each("workers", worker_info_from_proto, answer.workers), answer.health, answer.mood
            )

    @of_the_leader
    async def list_runs(self, *, closed: bool = False) -> tuple[RunInfo, ...]:
        """The runs that are open, oldest first; or those that are over and still kept, the one closed last first."""
        with cluster_errors(self._address):
            answer = await self._admin.ListRuns(pb.ListRunsRequest(closed=closed), timeout=self._call_s)
            return each("runs", run_info_from_proto, answer.runs)

    @of_the_leader
    async def drain_worker(self, worker_id: str) -> None:
        """The worker gets nothing new and leaves when it has finished what it holds. Raises NotFoundError."""
        with cluster_errors(self._address):
            await self._admin.DrainWorker(pb.DrainWorkerRequest(worker_id=worker_id), timeout=self._call_s)
