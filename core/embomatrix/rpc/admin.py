"""The operator's side of the cluster: what it does and did, and the levers on it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.rpc.fleet_client import FleetClient
from embomatrix.rpc.managers import of_the_leader
from embomatrix.rpc.status import cluster_errors
from embomatrix.rpc.wire.rollout import each, inside
from embomatrix.rpc.wire.run_log import event_page_from_proto, explanation_from_proto, run_summary_from_proto
from embomatrix.rpc.wire.session import plan_cell_from_proto

if TYPE_CHECKING:
    from embomatrix.rpc.run_log import EventPage, RolloutExplanation, RunEvent, RunSummary
    from embomatrix.rpc.wire.values import PlanCell


class AdminClient(FleetClient):
    """Async context manager over channels to a cluster: all that an operator asks. Every failure is a ``ClusterError``."""

    @of_the_leader
    async def run(self, run_id: str) -> RunSummary:
        """What a run came to, so far or in the end. Raises NotFoundError."""
        with cluster_errors(self._address):
            answer = await self._admin.GetRun(pb.GetRunRequest(run_id=run_id), timeout=self._call_s)
            return inside("summary", run_summary_from_proto, answer)

    @of_the_leader
    async def events(self, run_id: str = "", *, after: int = 0) -> EventPage:
        """One page of a run's log, or of the fleet's, of what came after that sequence. Raises NotFoundError."""
        request = pb.ReadEventsRequest(run_id=run_id, after=after)
        with cluster_errors(self._address):
            answer = await self._admin.ReadEvents(request, timeout=self._call_s)
            return inside("page", event_page_from_proto, answer)

    @of_the_leader
    async def explain(self, rollout_id: str) -> RolloutExplanation:
        """Return the recent history of a rollout. Raises NotFoundError."""
        request = pb.ExplainRolloutRequest(rollout_id=rollout_id)
        with cluster_errors(self._address):
            answer = await self._admin.ExplainRollout(request, timeout=self._call_s)
            return inside("explanation", explanation_from_proto, answer)

    async def all_events(self, run_id: str = "") -> tuple[RunEvent, ...]:
        """The whole log, as it is by now."""
        found: list[RunEvent] = []
        while page := (await self.events(run_id, after=found[-1].sequence if found else 0)).events:
            found += page
        return tuple(found)

    @of_the_leader
    async def resume(self, worker_id: str) -> None:
        """Take a drain back, as long as the worker has not left. Raises NotFoundError."""
        request = pb.ResumeWorkerRequest(worker_id=worker_id)
        with cluster_errors(self._address):
            await self._admin.ResumeWorker(request, timeout=self._call_s)

    @of_the_leader
    async def plan(self, run_id: str = "") -> tuple[PlanCell, ...]:
        """The look-ahead grid of one run, or of all: what each coming step needs, and who has it."""
        with cluster_errors(self._address):
            answer = await self._admin.GetPlan(pb.GetPlanRequest(run_id=run_id), timeout=self._call_s)
            return each("cells", plan_cell_from_proto, answer.cells)

    @of_the_leader
    async def pause_dispatch(self) -> None:
        """Have no new leases given; what runs goes on."""
        with cluster_errors(self._address):
            await self._admin.PauseDispatch(pb.PauseDispatchRequest(), timeout=self._call_s)

    @of_the_leader
    async def resume_dispatch(self) -> None:
        """Have leases given again."""
        with cluster_errors(self._address):
            await self._admin.ResumeDispatch(pb.ResumeDispatchRequest(), timeout=self._call_s)
