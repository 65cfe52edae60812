"""REST API of the cluster: state for viewers, commands for admins. All lists come from one snapshot, in pages.

``http_rules`` has checked the caller's role before a request arrives here.
"""

import asyncio
import contextlib
import dataclasses
import functools
import json
from collections.abc import AsyncIterator, Iterator, Mapping
from typing import Annotated, Any, Final, cast

from fastapi import APIRouter, Body, FastAPI, HTTPException, Path, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, StreamingResponse
from pydantic import BeforeValidator

from embomatrix.manager.access.gate import Gate, the_token
from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.registry import WorkerStanding
from embomatrix.manager.runtime.revocation import Revocation
from embomatrix.manager.web.cluster_view import LookaheadStep, Overview, Snapshots, worker_view
from embomatrix.manager.web.rest_values import (
    LARGEST_PAGE,
    PAGE,
    CallerView,
    Changed,
    EventList,
    Refusal,
    SnapshotPage,
    event_fields,
    snapshot_page,
)
from embomatrix.rpc.status import (
    ClusterError,
    InvalidRequestError,
    NotFoundError,
    OverloadedError,
    PreconditionError,
    UnavailableError,
)
from embomatrix.rpc.wire.run_log import EventKind
from embomatrix.rpc.wire.tokens import AccessRole

PREFIX: Final = "/api/v1"
VIEWERS: Final = 256
"""Concurrent event streams at most. A stream that is not read buffers one page at most."""
STATUSES: Final[Mapping[type[ClusterError], int]] = {
    InvalidRequestError: 422,
    NotFoundError: 404,
    OverloadedError: 503,
    PreconditionError: 409,
    UnavailableError: 503,
}
COMMANDS_NEED: Final = "A token of the role {role} may only read: commands need an admin's token."
LOOK_S: Final = 0.5
SILENCE_S: Final = 15.0
"""An idle stream sends a comment this often, so that proxies keep the connection open."""

SEARCH_CHARS: Final = 128
"""Longest text of a search, as long as the longest name of a worker and id of a run."""
FOUND_CHARS: Final = 64
"""Characters of an invalid value that its refusal repeats."""
REFUSALS: Final[dict[int | str, dict[str, Any]]] = {
    422: {"model": Refusal, "description": "Invalid parameter or body."}
}
"""Description of ``answer_errors`` for the OpenAPI page."""

Offset = Annotated[int, Query(ge=0, description="Rows to skip.")]
Limit = Annotated[int, Query(ge=1, le=LARGEST_PAGE, description="Maximum number of rows.")]
State = Annotated[
    WorkerStanding | None,
    # Forms send an empty value for every state.
    BeforeValidator(lambda text: text or None),
    Query(description="Only workers in this state.", examples=["ready"]),
]
Search = Annotated[
    str,
    Query(
        max_length=SEARCH_CHARS,
        description="Only workers with this text in their name; in lists, also in a label.",
    ),
]
Run = Annotated[str, Query(max_length=256, description="Run id; empty for the log of workers and scenes.")]
After = Annotated[int, Query(ge=0, description="Only events with a higher sequence number.")]
Worker = Annotated[str, Path(max_length=128, description="Name of the worker.", examples=["office-3"])]
Reason = Annotated[
    str, Body(embed=True, min_length=1, max_length=200, description="Reason, which the worker's owner sees.")
]


async def only_known_parameters(request: Request) -> None:
    """Refuse query parameters that the route does not have: a misspelt filter would show everything.

    A coroutine, because FastAPI would run a function in a thread, for every reward too.
    """
    known = sorted({parameter.alias for parameter in request.scope["route"].dependant.query_params})
    for name in request.query_params:
        if name not in known:
            expected = f"expected {', '.join(known)}" if known else "it has none"
            raise InvalidRequestError(f"{request.url.path} has no parameter {name[:64]!r}: {expected}")


def read_routes(runtime: ManagerRuntime, snapshots: Snapshots, gate: Gate) -> APIRouter:
    """Return the routes of viewers."""
    router = APIRouter(prefix=PREFIX, tags=["cluster"])

    @router.get("/snapshot", response_model=SnapshotPage, summary="State of the whole cluster at one moment")
    async def snapshot(
        state: State = None, search: Search = "", offset: Offset = 0, limit: Limit = PAGE
    ) -> Response:
        """All data of the dashboard's lists: health, figures, a page of workers, runs, look-ahead, training."""
        key = (state, search, offset, limit)
        text = snapshots.page(
            key,
            lambda seen: snapshot_page(seen, state=state or "", search=search, offset=offset, limit=limit),
        )
        return Response(text, media_type="application/json")

    @router.get("/caller", response_model=CallerView, summary="Role of your token")
    async def caller(request: Request) -> Response:
        """Role of the token that the request carries, and the reason why it may not send commands, if it may not."""
        role = gate.caller(the_token(request.headers.getlist("authorization"))).role
        refusal = "" if role is AccessRole.ADMIN else COMMANDS_NEED.format(role=role)
        return json_response(CallerView(role, refusal))

    _figures(router, snapshots)
    _logs(router, runtime)
    _stream(router, runtime)
    return router


def command_routes(runtime: ManagerRuntime, snapshots: Snapshots, revocation: Revocation) -> APIRouter:
    """Return the routes of admins."""
    router = APIRouter(prefix=PREFIX, tags=["commands"])

    @router.post("/workers/{worker_id}/drain", response_model=Changed, summary="Drain a worker")
    async def drain(worker_id: Worker) -> Changed:
        """Let a worker finish its leases, and give it no new ones."""
        with _changing(snapshots):
            runtime.drain_worker(worker_id)
        return _standing(runtime, worker_id)

    @router.post("/workers/{worker_id}/resume", response_model=Changed, summary="Resume a worker")
    async def resume(worker_id: Worker) -> Changed:
        """Cancel the drain, or lift the quarantine, of a worker that has not left."""
        with _changing(snapshots):
            runtime.resume_worker(worker_id)
        return _standing(runtime, worker_id)

    @router.post("/workers/{worker_id}/revoke", response_model=Changed, summary="Expel a worker")
    async def revoke(worker_id: Worker, reason: Reason) -> Changed:
        """Revoke a worker's credential and end its session. Its leases go to other workers."""
        with _changing(snapshots):
            await revocation.revoke_worker(worker_id, reason)
        return Changed(worker_id, "revoked")

    @router.post("/dispatch/pause", response_model=Changed, summary="Pause dispatch")
    async def pause() -> Changed:
        """Stop giving leases. Live leases continue."""
        with _changing(snapshots):
            await runtime.set_paused(True)
        return Changed("dispatch", "paused")

    @router.post("/dispatch/resume", response_model=Changed, summary="Resume dispatch")
    async def go_on() -> Changed:
        """Give leases again."""
        with _changing(snapshots):
            await runtime.set_paused(False)
        return Changed("dispatch", "running")

    return router


def _standing(runtime: ManagerRuntime, worker_id: str) -> Changed:
    """Return the state of a worker after a command, as lists show it: a quarantine hides a drain."""
    return Changed(worker_id, worker_view(runtime, worker_id).state)


def _figures(router: APIRouter, snapshots: Snapshots) -> None:
    @router.get("/overview", response_model=Overview, summary="Figures of the cluster")
    async def overview() -> Response:
        """Throughput, latency and its phases, queue, prewarming, outcomes and latest failures, without any lists."""
        return json_response(snapshots.now().overview)

    @router.get("/lookahead", response_model=list[LookaheadStep], summary="Scenes that coming steps need")
    async def lookahead() -> Response:
        """Steps that trainers announced, with the number of rollouts and the loading state of each scene."""
        return json_response(snapshots.now().lookahead)


def _logs(router: APIRouter, runtime: ManagerRuntime) -> None:
    @router.get("/events", response_model=EventList, summary="Events of a run, or of workers and scenes")
    async def events(run: Run = "", after: After = 0) -> Response:
        """Page of a log, oldest event first. Ask again with the last sequence number for the next page."""
        page = await runtime.history.events(run, after, 0)
        return JSONResponse({"events": list(map(event_fields, page.events)), "dropped": page.dropped})


def _stream(router: APIRouter, runtime: ManagerRuntime) -> None:
    viewers = 0

    @router.get("/events/stream", response_class=StreamingResponse, summary="New events as they happen")
    async def stream(run: Run = "", after: After = 0) -> Response:
        """New events as server-sent events: `id` is the sequence number, `data` the event as JSON."""
        nonlocal viewers
        await runtime.history.events(run, after, 1)
        if viewers >= VIEWERS:
            raise HTTPException(503, f"{VIEWERS} streams are open: close one, or ask for pages of /events")

        async def sent() -> AsyncIterator[str]:
            nonlocal viewers
            viewers += 1
            try:
                async for text in _growing(runtime, run, after):
                    yield text
            finally:
                viewers -= 1

        return StreamingResponse(
            sent(), media_type="text/event-stream", headers={"cache-control": "no-store"}
        )


async def _growing(runtime: ManagerRuntime, run: str, after: int) -> AsyncIterator[str]:
    """Yield events as they arrive, until the run is closed and all its events are sent."""
    silent_s = 0.0
    while True:
        try:
            page = await runtime.history.events(run, after, 0)
        except NotFoundError:
            return
        if not page.events and run and run not in runtime.event_log.runs:
            return
        for event in page.events:
            after = event.sequence
            yield f"id: {after}\ndata: {json.dumps(event_fields(event))}\n\n"
        if page.events and page.events[-1].kind is EventKind.RUN_CLOSED:
            return
        silent_s = 0.0 if page.events else silent_s + LOOK_S
        if silent_s >= SILENCE_S:
            silent_s = 0.0
            yield ": nothing new\n\n"
        await asyncio.sleep(LOOK_S)


def json_response(value: object) -> Response:
    """Return a dataclass, or a list of them, as JSON."""
    text = json.dumps(value, default=dataclasses.asdict, separators=(",", ":"), allow_nan=False)
    return Response(text, media_type="application/json")


def answer_errors(app: FastAPI) -> None:
    """Answer each ClusterError of a route, and each invalid parameter, with an HTTP error and a message."""
    for kind, status in STATUSES.items():
        app.add_exception_handler(kind, functools.partial(_problem, status))
    app.add_exception_handler(RequestValidationError, _invalid)


async def _problem(status: int, _: Request, error: Exception) -> Response:
    return JSONResponse({"detail": str(error)}, status)


async def _invalid(_: Request, error: Exception) -> Response:
    """Answer invalid parameters with one sentence that names each."""
    found = cast("RequestValidationError", error).errors()
    return JSONResponse({"detail": "; ".join(map(_refusal, found))}, 422)


def _refusal(problem: Mapping[str, Any]) -> str:
    place, *path = map(str, problem["loc"])
    words = problem["msg"]
    if words[1:2].islower():
        words = words[0].lower() + words[1:]
    if problem["type"] not in ("missing", "json_invalid"):
        words += f", found {str(problem['input'])[:FOUND_CHARS]!r}"
    return f"{place} {'.'.join(path)}: {words}" if path else f"{place}: {words}"


@contextlib.contextmanager
def _changing(snapshots: Snapshots) -> Iterator[None]:
    """Run a command, and let the next request see its effect."""
    try:
        yield
    finally:
        snapshots.forget()
