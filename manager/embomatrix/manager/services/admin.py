"""AdminService: lists, logs, operator commands, and tokens."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from grpc.aio import ServicerContext as Context

from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.revocation import Revocation
from embomatrix.manager.web.cluster_view import health, overview, plan, run_infos, worker_infos
from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.proto.v1 import admin_service_pb2_grpc
from embomatrix.rpc.status import translated
from embomatrix.rpc.wire.run_log import event_page_to_proto, explanation_to_proto, run_summary_to_proto
from embomatrix.rpc.wire.session import plan_cell_to_proto, run_info_to_proto, worker_info_to_proto
from embomatrix.rpc.wire.tokens import role_from_proto, token_info_to_proto

if TYPE_CHECKING:
    from embomatrix.manager.access.gate import Gate


@translated
class AdminServicer(admin_service_pb2_grpc.AdminServiceServicer):
    def __init__(self, runtime: ManagerRuntime, gate: Gate, revocation: Revocation) -> None:
        self._runtime = runtime
        self._gate = gate
        self._revocation = revocation

    async def ListWorkers(self, request: pb.ListWorkersRequest, context: Context) -> pb.ListWorkersResponse:
        workers = map(worker_info_to_proto, worker_infos(self._runtime))
        verdict = health(overview(self._runtime), paused=self._runtime.paused, now_s=time.time())
        return pb.ListWorkersResponse(workers=workers, health=verdict.sentence, mood=verdict.mood)

    async def ListRuns(self, request: pb.ListRunsRequest, context: Context) -> pb.ListRunsResponse:
        found = await self._runtime.history.kept() if request.closed else run_infos(self._runtime)
        return pb.ListRunsResponse(runs=map(run_info_to_proto, found))

    async def GetRun(self, request: pb.GetRunRequest, context: Context) -> pb.GetRunResponse:
        return run_summary_to_proto(await self._runtime.history.summary(request.run_id))

    async def ReadEvents(self, request: pb.ReadEventsRequest, context: Context) -> pb.ReadEventsResponse:
        page = await self._runtime.history.events(request.run_id, request.after, request.limit)
        # Thousands of events take longer than other calls should wait.
        return await asyncio.to_thread(event_page_to_proto, page)

    async def ExplainRollout(
        self, request: pb.ExplainRolloutRequest, context: Context
    ) -> pb.ExplainRolloutResponse:
        return explanation_to_proto(await self._runtime.history.explain(request.rollout_id))

    async def DrainWorker(self, request: pb.DrainWorkerRequest, context: Context) -> pb.DrainWorkerResponse:
        self._runtime.drain_worker(request.worker_id)
        return pb.DrainWorkerResponse()

    async def ResumeWorker(
        self, request: pb.ResumeWorkerRequest, context: Context
    ) -> pb.ResumeWorkerResponse:
        self._runtime.resume_worker(request.worker_id)
        return pb.ResumeWorkerResponse()

    async def GetPlan(self, request: pb.GetPlanRequest, context: Context) -> pb.GetPlanResponse:
        cells = plan(self._runtime, request.run_id)
        return pb.GetPlanResponse(cells=map(plan_cell_to_proto, cells))

    async def PauseDispatch(
        self, request: pb.PauseDispatchRequest, context: Context
    ) -> pb.PauseDispatchResponse:
        await self._runtime.set_paused(True)
        return pb.PauseDispatchResponse()

    async def ResumeDispatch(
        self, request: pb.ResumeDispatchRequest, context: Context
    ) -> pb.ResumeDispatchResponse:
        await self._runtime.set_paused(False)
        return pb.ResumeDispatchResponse()

    async def IssueToken(self, request: pb.IssueTokenRequest, context: Context) -> pb.IssueTokenResponse:
        role = role_from_proto(request.role)
        token, token_id = await self._gate.issue(role, valid_s=request.valid_s, label=request.label)
        return pb.IssueTokenResponse(token=token, token_id=token_id)

    async def ListTokens(self, request: pb.ListTokensRequest, context: Context) -> pb.ListTokensResponse:
        return pb.ListTokensResponse(tokens=map(token_info_to_proto, self._gate.infos()))

    async def RevokeToken(self, request: pb.RevokeTokenRequest, context: Context) -> pb.RevokeTokenResponse:
        await self._revocation.revoke_token(request.token_id)
        return pb.RevokeTokenResponse()

    async def RevokeWorker(
        self, request: pb.RevokeWorkerRequest, context: Context
    ) -> pb.RevokeWorkerResponse:
        await self._revocation.revoke_worker(request.worker_id, request.reason[:200] or "by the operator")
        return pb.RevokeWorkerResponse()
