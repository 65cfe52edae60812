"""The status page and its JSON: read only. Nothing here changes the cluster."""

from __future__ import annotations

import dataclasses
from importlib.resources import files
from typing import TYPE_CHECKING

from fastapi import APIRouter, FastAPI
from fastapi.responses import HTMLResponse, JSONResponse, Response

from embomatrix.manager import views
from embomatrix.manager.http_rules import Guard
from embomatrix.manager.prometheus import CONTENT_TYPE, metrics_page

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.manager.http_rules import HttpRules
    from embomatrix.manager.runtime import ManagerRuntime


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

    @router.get("/api/lookahead")
    async def lookahead() -> JSONResponse:
        return _rows(views.lookahead(runtime))

    @router.get("/metrics")
    async def metrics() -> Response:
        return Response(metrics_page(runtime), media_type=CONTENT_TYPE)

    return router


def _rows(rows: Sequence[views.WorkerView | views.RunView | views.LookaheadStep]) -> JSONResponse:
    return JSONResponse([dataclasses.asdict(row) for row in rows])
