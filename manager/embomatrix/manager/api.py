"""The status page and its JSON: read only. Nothing here changes the cluster."""

from __future__ import annotations

import contextlib
import dataclasses
from importlib.resources import files
from typing import TYPE_CHECKING

from fastapi import APIRouter, FastAPI, HTTPException
from fastapi.responses import HTMLResponse, JSONResponse, Response

from embomatrix.manager import views
from embomatrix.manager.http_rules import Guard
from embomatrix.manager.prometheus import CONTENT_TYPE, metrics_page
from embomatrix.rpc.status import NotFoundError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.manager.http_rules import HttpRules
    from embomatrix.manager.runtime import ManagerRuntime
    from embomatrix.rpc.run_log import RunEvent


def build_api(runtime: ManagerRuntime, rules: HttpRules) -> FastAPI:
    """The application. With tokens, everything but the empty page and the health check asks for one."""
    app = FastAPI(title="EmboMatrix manager", docs_url=None, redoc_url=None, openapi_url=None)
    app.add_middleware(Guard, rules=rules)

    @app.get("/", response_class=HTMLResponse)
    def page() -> str:
        return files("embomatrix.manager").joinpath("dashboard/index.html").read_text(encoding="utf-8")

    @app.get("/healthz")
    async def health() -> dict[str, str]:
        return {"status": "ok"}

    app.include_router(_figures(runtime))
    return app


def _figures(runtime: ManagerRuntime) -> APIRouter:
    """What tells something about the cluster."""
    router = APIRouter()

    @router.get("/api/overview")
    async def overview() -> JSONResponse:
        return JSONResponse(dataclasses.asdict(views.overview(runtime)))

    @router.get("/api/workers")
    async def workers() -> JSONResponse:
        return _rows(views.workers(runtime))

    @router.get("/api/runs")
    async def runs() -> JSONResponse:
        return _rows(views.runs(runtime))

    @router.get("/api/runs/{run_id}")
    async def run(run_id: str) -> JSONResponse:
        with _not_found():
            summary = await runtime.history.summary(run_id)
        told = dataclasses.asdict(dataclasses.replace(summary, failures=()))
        return JSONResponse({**told, "failures": [_event(event) for event in summary.failures]})

    @router.get("/api/events")
    async def events(run: str = "", after: int = 0) -> JSONResponse:
        with _not_found():
            page = await runtime.history.events(run, after, 0)
        return JSONResponse({"events": [_event(event) for event in page.events], "dropped": page.dropped})

    @router.get("/api/lookahead")
    async def lookahead() -> JSONResponse:
        return _rows(views.lookahead(runtime))

    @router.get("/metrics")
    async def metrics() -> Response:
        return Response(metrics_page(runtime), media_type=CONTENT_TYPE)

    return router


def _event(event: RunEvent) -> dict[str, object]:
    """What applies to it."""
    timings = dataclasses.asdict(event.timings) if event.timings is not None else None
    told = event._replace(timings=None)._asdict() | {"timings": timings}
    return {name: value for name, value in told.items() if value}


@contextlib.contextmanager
def _not_found() -> Iterator[None]:
    try:
        yield
    except NotFoundError as error:
        raise HTTPException(404, str(error)) from error


def _rows(rows: Sequence[views.WorkerView | views.RunView | views.LookaheadStep]) -> JSONResponse:
    return JSONResponse([dataclasses.asdict(row) for row in rows])
