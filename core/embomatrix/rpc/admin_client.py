"""Client of AdminService: workers, runs, logs, tokens, and the operator's commands."""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Concatenate, Final, ParamSpec, Self, TypeVar

import grpc

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.proto.v1 import admin_service_pb2_grpc, rollout_service_pb2, rollout_service_pb2_grpc
from embomatrix.rpc.channel import DEFAULT_ADDRESS, open_channel
from embomatrix.rpc.managers import FAILOVER_S, Managers
from embomatrix.rpc.status import InvalidRequestError, UnavailableError, cluster_errors
from embomatrix.rpc.wire.codec import each, inside
from embomatrix.rpc.wire.run import run_stats_from_proto
from embomatrix.rpc.wire.run_log import (
    EventPage,
    RolloutExplanation,
    RunEvent,
    RunSummary,
    event_page_from_proto,
    explanation_from_proto,
    run_summary_from_proto,
)
from embomatrix.rpc.wire.session import plan_cell_from_proto, run_info_from_proto, worker_info_from_proto
from embomatrix.rpc.wire.tokens import ROLE_NUMBERS, AccessRole, TokenInfo, token_info_from_proto
from embomatrix.rpc.wire.values import FleetStatus, PlanCell, RunInfo, RunStats, WorkerInfo

CALL_S: Final = 10.0
"""Default time limit of one call."""
NAMED: Final = 5
"""Ids of runs of one name that a message lists at most."""
PAUSE_S: Final = 0.2
"""Pause between calls to two managers."""
P = ParamSpec("P")
T = TypeVar("T")
C = TypeVar("C", bound="AdminClient")


def of_the_leader(
    method: Callable[Concatenate[C, P], Awaitable[T]],
) -> Callable[Concatenate[C, P], Coroutine[Any, Any, T]]:
    """Translate the errors of a client's call, and repeat it at the next manager while the current one is unavailable."""

    @functools.wraps(method)
    async def call(self: C, /, *args: P.args, **options: P.kwargs) -> T:
        ends_s = time.monotonic() + self.failover_s
        while True:
            try:
                with cluster_errors(self._address):
                    return await method(self, *args, **options)
            except UnavailableError as error:
                if self.managers.count == 1 or time.monotonic() >= ends_s:
                    raise
                self.managers.move(error)
            await asyncio.sleep(PAUSE_S)

    return call


class AdminClient:
    """Async context manager over calls that need no run, to the leading manager of a cluster.

    ``address`` is HOST:PORT, or several with commas between them. ``ca`` (PEM) turns TLS on. The role of the token decides
    which calls are allowed. Every failure is a ClusterError.
    """

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        token: str = "",
        *,
        ca: bytes = b"",
        call_s: float = CALL_S,
        failover_s: float = FAILOVER_S,
    ) -> None:
        self.managers = Managers(address)
        self.failover_s = failover_s
        self._call_s = call_s
        self._token = token
        self._ca = ca
        self._channels: dict[str, grpc.aio.Channel] = {}

    async def __aenter__(self) -> Self:
        _ = self._channel  # a token that cannot be sent is refused here, not at the first call
        return self

    async def __aexit__(self, *_: object) -> None:
        for channel in self._channels.values():
            await channel.close()

    @property
    def _address(self) -> str:
        return self.managers.current

    @property
    def _channel(self) -> grpc.aio.Channel:
        """Channel to the current manager. Earlier channels stay open, since calls may still use them."""
        if self._address not in self._channels:
            self._channels[self._address] = open_channel(self._address, self._token, self._ca)
        return self._channels[self._address]

    @property
    def _admin(self) -> admin_service_pb2_grpc.AdminServiceAsyncStub:
        return admin_service_pb2_grpc.AdminServiceStub(self._channel)

    async def list_workers(self) -> tuple[WorkerInfo, ...]:
        """Return the workers that the manager knows, including recently lost ones."""
        return (await self.fleet()).workers

    @of_the_leader
    async def fleet(self) -> FleetStatus:
        """Return the workers and the health of the cluster."""
        answer = await self._admin.ListWorkers(pb.ListWorkersRequest(), timeout=self._call_s)
        return FleetStatus(
            each("workers", worker_info_from_proto, answer.workers), answer.health, answer.mood
        )

    @of_the_leader
    async def list_runs(self, *, closed: bool = False) -> tuple[RunInfo, ...]:
        """Return the open runs, oldest first; or the archived runs, the last closed first."""
        answer = await self._admin.ListRuns(pb.ListRunsRequest(closed=closed), timeout=self._call_s)
        return each("runs", run_info_from_proto, answer.runs)

    @of_the_leader
    async def run(self, run_id: str) -> RunSummary:
        """Return the totals of an open or archived run. Raises NotFoundError."""
        answer = await self._admin.GetRun(pb.GetRunRequest(run_id=run_id), timeout=self._call_s)
        return inside("summary", run_summary_from_proto, answer)

    @of_the_leader
    async def close_run(self, run_id: str) -> RunStats:
        """Close an open run, for example of a trainer that was killed, and return its counters. Raises NotFoundError."""
        stub = rollout_service_pb2_grpc.RolloutServiceStub(self._channel)
        request = rollout_service_pb2.CloseRunRequest(run_id=run_id)
        answer = await stub.CloseRun(request, timeout=self._call_s)
        return inside("stats", run_stats_from_proto, answer.stats)

    async def find_run(self, run: str) -> str:
        """Return the id of the run with this id or name; the text itself if there is none.

        Raises InvalidRequestError if several runs have the name.
        """
        runs = (*await self.list_runs(), *await self.list_runs(closed=True))
        if any(found.run_id == run for found in runs):
            return run
        named = list(dict.fromkeys(found.run_id for found in runs if found.name == run))
        if len(named) > 1:
            raise InvalidRequestError(
                f"{len(named)} runs are named {run!r}: pass the id of one, {' or '.join(named[:NAMED])}; "
                "`embomatrix cluster runs` and `runs --closed` show when each was open"
            )
        return named[0] if named else run

    @of_the_leader
    async def read_events(self, run_id: str = "", *, after: int = 0) -> EventPage:
        """Return a page of a run's log, or of the fleet's, with sequences above ``after``. Raises NotFoundError."""
        request = pb.ReadEventsRequest(run_id=run_id, after=after)
        return inside(
            "page", event_page_from_proto, await self._admin.ReadEvents(request, timeout=self._call_s)
        )

    @of_the_leader
    async def explain(self, rollout_id: str) -> RolloutExplanation:
        """Return the recent history of a rollout. Raises NotFoundError."""
        request = pb.ExplainRolloutRequest(rollout_id=rollout_id)
        answer = await self._admin.ExplainRollout(request, timeout=self._call_s)
        return inside("explanation", explanation_from_proto, answer)

    async def all_events(self, run_id: str = "") -> tuple[RunEvent, ...]:
        """Return the whole log of a run, or of the fleet."""
        found: list[RunEvent] = []
        while page := (await self.read_events(run_id, after=found[-1].sequence if found else 0)).events:
            found += page
        return tuple(found)

    @of_the_leader
    async def plan(self, run_id: str = "") -> tuple[PlanCell, ...]:
        """Return the look-ahead grid of a run, or of all runs."""
        answer = await self._admin.GetPlan(pb.GetPlanRequest(run_id=run_id), timeout=self._call_s)
        return each("cells", plan_cell_from_proto, answer.cells)

    @of_the_leader
    async def drain_worker(self, worker_id: str) -> None:
        """Let a worker finish its leases, give it no new ones, and have it leave. Raises NotFoundError."""
        await self._admin.DrainWorker(pb.DrainWorkerRequest(worker_id=worker_id), timeout=self._call_s)

    @of_the_leader
    async def resume(self, worker_id: str) -> None:
        """Cancel the drain, or lift the quarantine, of a connected worker. Raises NotFoundError."""
        await self._admin.ResumeWorker(pb.ResumeWorkerRequest(worker_id=worker_id), timeout=self._call_s)

    @of_the_leader
    async def pause_dispatch(self) -> None:
        """Stop giving leases. Live leases continue."""
        await self._admin.PauseDispatch(pb.PauseDispatchRequest(), timeout=self._call_s)

    @of_the_leader
    async def resume_dispatch(self) -> None:
        """Give leases again."""
        await self._admin.ResumeDispatch(pb.ResumeDispatchRequest(), timeout=self._call_s)

    @of_the_leader
    async def issue_token(
        self, role: AccessRole, *, valid_s: float = 0.0, label: str = ""
    ) -> tuple[str, str]:
        """Return a new token and its id. The manager keeps only a hash. ``valid_s`` 0: until revoked."""
        request = pb.IssueTokenRequest(role=ROLE_NUMBERS[role], valid_s=valid_s, label=label)
        answer = await self._admin.IssueToken(request, timeout=self._call_s)
        return answer.token, answer.token_id

    @of_the_leader
    async def list_tokens(self) -> tuple[TokenInfo, ...]:
        """Return the valid tokens."""
        answer = await self._admin.ListTokens(pb.ListTokensRequest(), timeout=self._call_s)
        return each("tokens", token_info_from_proto, answer.tokens)

    @of_the_leader
    async def revoke_token(self, token_id: str) -> None:
        """Revoke a token and end the sessions that were opened with it."""
        await self._admin.RevokeToken(pb.RevokeTokenRequest(token_id=token_id), timeout=self._call_s)

    @of_the_leader
    async def revoke_worker(self, worker_id: str, reason: str = "") -> None:
        """Revoke a worker's credential and end its session. Its leases go to other workers."""
        request = pb.RevokeWorkerRequest(worker_id=worker_id, reason=reason)
        await self._admin.RevokeWorker(request, timeout=self._call_s)
