"""The REST API: what the cluster does, and an operator's verbs. Lists come from one snapshot, in pages.

Who may ask is decided before, by ``http_rules``: reading takes a viewer's token, a change an admin's and no page elsewhere.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import json
from typing import TYPE_CHECKING, Annotated, Any, Final

from fastapi import APIRouter, Body, HTTPException, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse

from embomatrix.manager.observe.training_reports import TrainingDetail, TrainingView
from embomatrix.manager.web.packing import packed
from embomatrix.manager.web.rest_values import (
    LARGEST_PAGE,
    PAGE,
    Changed,
    RunPage,
    SnapshotPage,
    Timeline,
    WorkerPage,
    run_page,
    worker_page,
)
from embomatrix.manager.web.slot_tracks import timeline
from embomatrix.manager.web.views import LookaheadStep, Overview
from embomatrix.rpc.status import (
    ClusterError,
    InvalidRequestError,
    NotFoundError,
    OverloadedError,
    PreconditionError,
    UnavailableError,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator, Mapping

    from embomatrix.manager.runtime.event_loop import ManagerRuntime
    from embomatrix.manager.services.expulsion import Expulsion
    from embomatrix.manager.web.snapshot import Snapshot, Snapshots
    from embomatrix.rpc.run_log import RunEvent

PREFIX: Final = "/api/v1"
VIEWERS: Final = 256
"""Streams of events at the same time. One that nobody reads waits, and keeps no more than a page."""
STATUSES: Final[Mapping[type[ClusterError], int]] = {
    InvalidRequestError: 422,
    NotFoundError: 404,
    OverloadedError: 503,
    PreconditionError: 409,
    UnavailableError: 503,
}
LOOK_S: Final = 0.5
SILENCE_S: Final = 15.0
"""After so long without an event a stream says that it is alive: what lies between closes quiet connections."""
LONGEST_S: Final = 3600.0

Offset = Annotated[int, Query(ge=0, description="Rows to leave out.")]
Limit = Annotated[int, Query(ge=1, le=LARGEST_PAGE, description="Rows at most.")]
State = Annotated[str, Query(max_length=32, description="Only workers in this state.", examples=["ready"])]
Search = Annotated[
    str,
    Query(max_length=64, description="Only workers with this in their name; in lists, or in a label."),
]
Run = Annotated[str, Query(max_length=256, description="A run's id; empty: the log of workers and scenes.")]
After = Annotated[int, Query(ge=0, description="Only events beyond this sequence.")]
Seconds = Annotated[float, Query(gt=0, le=LONGEST_S, description="How far back to look.")]
Reason = Annotated[
    str, Body(embed=True, min_length=1, max_length=200, description="Why: its owner reads it.")
]


def reading(runtime: ManagerRuntime, snapshots: Snapshots) -> APIRouter:
    """What a viewer may ask."""
    router = APIRouter(prefix=PREFIX, tags=["look"])

    @router.get("/snapshot", response_model=SnapshotPage)
    async def snapshot(
        request: Request, state: State = "", search: Search = "", offset: Offset = 0, limit: Limit = PAGE
    ) -> Response:
        """The cluster at one moment: health, figures, a page of workers, runs, look-ahead, training."""

        page = functools.partial(_snapshot_page, state=state, search=search, offset=offset, limit=limit)
        return packed(request, snapshots.told((state, search, offset, limit), page))

    @router.get("/workers", response_model=WorkerPage)
    async def workers(
        state: State = "", search: Search = "", offset: Offset = 0, limit: Limit = PAGE
    ) -> Response:
        """Workers, those first that don't work."""
        return _json(worker_page(snapshots.now(), state=state, search=search, offset=offset, limit=limit))

    @router.get("/runs", response_model=RunPage)
    async def runs(offset: Offset = 0, limit: Limit = PAGE) -> Response:
        """Open runs, the one opened last first."""
        return _json(run_page(snapshots.now(), offset=offset, limit=limit))

    _figures(router, snapshots)
    _logs(router, runtime)
    _training(router, runtime, snapshots)
    _stream(router, runtime)
    return router


def _snapshot_page(seen: Snapshot, *, state: str, search: str, offset: int, limit: int) -> SnapshotPage:
    workers = worker_page(seen, state=state, search=search, offset=offset, limit=limit)
    return SnapshotPage(
        seen.at_s,
        seen.health,
        seen.paused,
        seen.overview,
        workers,
        seen.runs,
        seen.lookahead,
        seen.training,
    )


def changing(runtime: ManagerRuntime, snapshots: Snapshots, expulsion: Expulsion) -> APIRouter:
    """What an admin may do."""
    router = APIRouter(prefix=PREFIX, tags=["steer"])

    @router.post("/workers/{worker_id}/drain", response_model=Changed)
    async def drain(worker_id: str) -> Changed:
        """It finishes what it holds and gets nothing new."""
        with _told(snapshots):
            runtime.drain_worker(worker_id)
        return Changed(worker_id, "draining")

    @router.post("/workers/{worker_id}/resume", response_model=Changed)
    async def resume(worker_id: str) -> Changed:
        """Take a drain back, as long as the worker has not left."""
        with _told(snapshots):
            runtime.resume_worker(worker_id)
        return Changed(worker_id, "ready")

    @router.post("/workers/{worker_id}/revoke", response_model=Changed)
    async def revoke(worker_id: str, reason: Reason) -> Changed:
        """Its credential is void, its session ends, what it held goes to others."""
        with _told(snapshots):
            await expulsion.revoke_worker(worker_id, reason)
        return Changed(worker_id, "revoked")

    @router.post("/dispatch/pause", response_model=Changed)
    async def pause() -> Changed:
        """No new leases for any worker; what runs goes on."""
        with _told(snapshots):
            await runtime.pause_dispatch()
        return Changed("dispatch", "paused")

    @router.post("/dispatch/resume", response_model=Changed)
    async def go_on() -> Changed:
        """Leases again."""
        with _told(snapshots):
            await runtime.resume_dispatch()
        return Changed("dispatch", "running")

    return router


def _figures(router: APIRouter, snapshots: Snapshots) -> None:
    @router.get("/overview", response_model=Overview)
    async def overview() -> Response:
        """The figures alone."""
        return _json(snapshots.now().overview)

    @router.get("/lookahead", response_model=list[LookaheadStep])
    async def lookahead() -> Response:
        """The scenes that coming steps need, and how far each is."""
        return JSONResponse([dataclasses.asdict(step) for step in snapshots.now().lookahead])


def _logs(router: APIRouter, runtime: ManagerRuntime) -> None:
    history = runtime.history

    @router.get("/runs/{run_id}")
    async def run(run_id: str) -> Response:
        """What a run came to, so far or in the end; also of the last 50 that were closed."""
        with answered():
            summary = await history.summary(run_id)
        told = dataclasses.asdict(dataclasses.replace(summary, failures=()))
        return JSONResponse({**told, "failures": [_event(event) for event in summary.failures]})

    @router.get("/runs/{run_id}/timeline", response_model=Timeline)
    async def tracks(run_id: str, seconds: Seconds = 60.0, search: Search = "") -> Response:
        """What each slot did in the last seconds of a run, on workers with the text in their name."""
        with answered():
            latest = await history.latest(run_id, seconds)
            return _json(timeline(run_id, latest, seconds=seconds, search=search))

    @router.get("/events")
    async def events(run: Run = "", after: After = 0) -> Response:
        """A page of the log of a run, or of workers and scenes."""
        with answered():
            page = await history.events(run, after, 0)
        return JSONResponse({"events": [_event(event) for event in page.events], "dropped": page.dropped})


def _training(router: APIRouter, runtime: ManagerRuntime, snapshots: Snapshots) -> None:
    @router.get("/training", response_model=list[TrainingView])
    async def reporting() -> Response:
        """Runs whose trainers report, the one that did last first; also some that were closed."""
        return JSONResponse([dataclasses.asdict(view) for view in snapshots.now().training])

    @router.get("/training/{run_id}", response_model=TrainingDetail)
    async def detail(request: Request, run_id: str) -> Response:
        """Learning curves of a run, and plans that its policy wrote of late."""
        with answered():
            told = dataclasses.asdict(runtime.training.detail(run_id))
        return packed(request, json.dumps(told, separators=(",", ":")).encode())


def _stream(router: APIRouter, runtime: ManagerRuntime) -> None:
    viewers = 0

    @router.get("/events/stream", response_class=StreamingResponse)
    async def stream(run: Run = "", after: After = 0) -> Response:
        """The same as it grows, as server-sent events: `id` is the sequence, `data` the event as JSON."""
        nonlocal viewers
        with answered():
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
    """Events as they come, until the run's log is gone or the viewer is."""
    silent_s = 0.0
    while True:
        try:
            page = await runtime.history.events(run, after, 0)
        except NotFoundError:
            return
        for event in page.events:
            after = event.sequence
            yield f"id: {after}\ndata: {json.dumps(_event(event))}\n\n"
        silent_s = 0.0 if page.events else silent_s + LOOK_S
        if silent_s >= SILENCE_S:
            silent_s = 0.0
            yield ": nothing new\n\n"
        await asyncio.sleep(LOOK_S)


def _event(event: RunEvent) -> dict[str, Any]:
    """What applies to it."""
    timings = dataclasses.asdict(event.timings) if event.timings is not None else None
    told = event._replace(timings=None)._asdict() | {"timings": timings}
    return {name: value for name, value in told.items() if value}


def _json(value: Any) -> Response:
    return JSONResponse(dataclasses.asdict(value))


@contextlib.contextmanager
def answered() -> Iterator[None]:
    """What can't be is an answer, with the same sentence that gRPC has for it."""
    try:
        yield
    except tuple(STATUSES) as error:
        status = next(number for kind, number in STATUSES.items() if isinstance(error, kind))
        raise HTTPException(status, str(error)) from error


@contextlib.contextmanager
def _told(snapshots: Snapshots) -> Iterator[None]:
    """A change: who looks next sees what it came to."""
    try:
        with answered():
            yield
    finally:
        snapshots.forget()
