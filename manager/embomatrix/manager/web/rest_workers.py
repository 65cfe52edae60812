"""REST API of workers: lists, the use of each one's machine, and its log."""

import time

from fastapi import APIRouter, Response

from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.registry import name_list
from embomatrix.manager.web.cluster_view import Snapshots, worker_view
from embomatrix.manager.web.rest import PREFIX, Limit, Offset, Search, State, Worker, json_response
from embomatrix.manager.web.rest_values import PAGE, WorkerDetail, WorkerLog, WorkerPage, worker_page
from embomatrix.rpc.status import NotFoundError


def worker_routes(runtime: ManagerRuntime, snapshots: Snapshots) -> APIRouter:
    """Return the routes of viewers about workers."""
    router = APIRouter(prefix=PREFIX, tags=["workers"])

    @router.get("/workers", response_model=WorkerPage, summary="Workers by state, name or label")
    async def workers(
        state: State = None, search: Search = "", offset: Offset = 0, limit: Limit = PAGE
    ) -> Response:
        """Page of workers, those that need attention first."""
        page = worker_page(snapshots.now(), state=state or "", search=search, offset=offset, limit=limit)
        return json_response(page)

    @router.get("/workers/{worker_id}", response_model=WorkerDetail, summary="One worker and its machine")
    async def worker(worker_id: Worker) -> Response:
        """State, scenes and counters of a worker, and CPU and memory of its machine in the last half hour."""
        _check_known(runtime, worker_id)
        view = worker_view(runtime, worker_id)
        return json_response(WorkerDetail(time.time(), view, runtime.hosts.curve_of(worker_id)))

    @router.get("/workers/{worker_id}/log", response_model=WorkerLog, summary="Last log lines of a worker")
    async def log(worker_id: Worker) -> Response:
        """Latest 50 lines of the worker's log, oldest first, with tokens and passwords as `***`."""
        _check_known(runtime, worker_id)
        return json_response(WorkerLog(worker_id, runtime.hosts.lines_of(worker_id)))

    return router


def _check_known(runtime: ManagerRuntime, worker_id: str) -> None:
    if worker_id not in runtime.registry.sessions:
        raise NotFoundError(
            f"there is no worker {worker_id!r} (connected: {name_list(runtime.registry.present)}): it may have left "
            "more than five minutes ago"
        )
