"""The operator's side of the cluster: what it does and did, and the levers on it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.proto.v1 import admin_service_pb2_grpc
from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.convert import each, inside
from embomatrix.rpc.convert_log import event_page_from_proto, run_summary_from_proto
from embomatrix.rpc.convert_session import plan_cell_from_proto, run_info_from_proto, worker_info_from_proto
from embomatrix.rpc.leader_client import LeaderClient
from embomatrix.rpc.managers import of_the_leader
from embomatrix.rpc.status import cluster_errors

if TYPE_CHECKING:
    from embomatrix.rpc.run_log import EventPage, RunEvent, RunSummary
    from embomatrix.rpc.values import PlanCell, RunInfo, WorkerInfo

CALL_S: Final = 10.0
"""For the answer to one call."""


class AdminClient(LeaderClient):
    """Async context manager over channels to the manager at HOST:PORT, or to several of which one leads.

    Every failure is a ``ClusterError``.
    """

    def __init__(
        self, address: str = DEFAULT_ADDRESS, token: str = "", *, ca: bytes = b"", call_s: float = CALL_S
    ) -> None:
        super().__init__(address, token, ca=ca)
        self._call_s = call_s

    @property
    def _stub(self) -> admin_service_pb2_grpc.AdminServiceAsyncStub:
        return admin_service_pb2_grpc.AdminServiceStub(self._channel)

    @of_the_leader
    async def workers(self) -> tuple[WorkerInfo, ...]:
        """The workers that the manager knows, also those that it lost a moment ago."""
        with cluster_errors(self._address):
            answer = await self._stub.ListWorkers(pb.ListWorkersRequest(), timeout=self._call_s)
            return each("workers", worker_info_from_proto, answer.workers)

    async def open_runs(self) -> tuple[RunInfo, ...]:
        """Oldest first."""
        return await self._runs(pb.ListRunsRequest())

    async def closed_runs(self) -> tuple[RunInfo, ...]:
        """Those that the manager still keeps, the one that was closed last first."""
        return await self._runs(pb.ListRunsRequest(closed=True))

    @of_the_leader
    async def run(self, run_id: str) -> RunSummary:
        """What a run came to, so far or in the end. Raises NotFoundError."""
        with cluster_errors(self._address):
            answer = await self._stub.GetRun(pb.GetRunRequest(run_id=run_id), timeout=self._call_s)
            return inside("summary", run_summary_from_proto, answer)

    @of_the_leader
    async def events(self, run_id: str = "", *, after: int = 0) -> EventPage:
        """One page of a run's log, or of the fleet's, of what came after that sequence. Raises NotFoundError."""
        request = pb.ReadEventsRequest(run_id=run_id, after=after)
        with cluster_errors(self._address):
            answer = await self._stub.ReadEvents(request, timeout=self._call_s)
            return inside("page", event_page_from_proto, answer)

    async def all_events(self, run_id: str = "") -> tuple[RunEvent, ...]:
        """The whole log, as it is by now."""
        found: list[RunEvent] = []
        while page := (await self.events(run_id, after=found[-1].sequence if found else 0)).events:
            found += page
        return tuple(found)

    @of_the_leader
    async def drain(self, worker_id: str) -> None:
        """The worker gets nothing new and leaves when it has finished what it holds. Raises NotFoundError."""
        with cluster_errors(self._address):
            await self._stub.DrainWorker(pb.DrainWorkerRequest(worker_id=worker_id), timeout=self._call_s)

    @of_the_leader
    async def resume(self, worker_id: str) -> None:
        """Take a drain back, as long as the worker has not left. Raises NotFoundError."""
        request = pb.ResumeWorkerRequest(worker_id=worker_id)
        with cluster_errors(self._address):
            await self._stub.ResumeWorker(request, timeout=self._call_s)

    @of_the_leader
    async def plan(self, run_id: str = "") -> tuple[PlanCell, ...]:
        """The look-ahead grid of one run, or of all: what each coming step needs, and who has it."""
        with cluster_errors(self._address):
            answer = await self._stub.GetPlan(pb.GetPlanRequest(run_id=run_id), timeout=self._call_s)
            return each("cells", plan_cell_from_proto, answer.cells)

    @of_the_leader
    async def pause_dispatch(self) -> None:
        """Have no new leases given; what runs goes on."""
        with cluster_errors(self._address):
            await self._stub.PauseDispatch(pb.PauseDispatchRequest(), timeout=self._call_s)

    @of_the_leader
    async def resume_dispatch(self) -> None:
        """Have leases given again."""
        with cluster_errors(self._address):
            await self._stub.ResumeDispatch(pb.ResumeDispatchRequest(), timeout=self._call_s)

    @of_the_leader
    async def _runs(self, request: pb.ListRunsRequest) -> tuple[RunInfo, ...]:
        with cluster_errors(self._address):
            answer = await self._stub.ListRuns(request, timeout=self._call_s)
            return each("runs", run_info_from_proto, answer.runs)
