"""The status page and its JSON: read only. Nothing here changes the cluster."""

from __future__ import annotations

import dataclasses
from importlib.resources import files
from typing import TYPE_CHECKING, Annotated

from fastapi import APIRouter, Depends, FastAPI, Header, HTTPException
from fastapi.middleware.trustedhost import TrustedHostMiddleware
from fastapi.responses import HTMLResponse, JSONResponse, Response

from embomatrix.manager import views
from embomatrix.manager.prometheus import CONTENT_TYPE, metrics_page
from embomatrix.manager.service_auth import token_fits
from embomatrix.manager.settings import is_loopback

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from embomatrix.manager.runtime import ManagerRuntime
    from embomatrix.manager.settings import ManagerSettings


def build_api(runtime: ManagerRuntime, settings: ManagerSettings) -> FastAPI:
    """The application. With a token, everything but the empty page and the health check asks for it."""
    app = FastAPI(title="EmboMatrix manager", docs_url=None, redoc_url=None, openapi_url=None)
    if is_loopback(settings.http_host):
        # A web page elsewhere must not reach this one under a name of its own (DNS rebinding).
        app.add_middleware(
            TrustedHostMiddleware, allowed_hosts=["localhost", "127.0.0.1", "[::1]", "testserver"]
        )

    @app.get("/", response_class=HTMLResponse)
    def page() -> str:
        return files("embomatrix.manager").joinpath("dashboard/index.html").read_text(encoding="utf-8")

    @app.get("/healthz")
    async def health() -> dict[str, str]:
        return {"status": "ok"}

    app.include_router(_figures(runtime), dependencies=[Depends(_token_check(settings.token))])
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


def _token_check(token: str) -> Callable[[str], None]:
    def check(authorization: Annotated[str, Header()] = "") -> None:
        if token and not token_fits(authorization, token):
            raise HTTPException(401, "no token, or a wrong one: send `Authorization: Bearer TOKEN`")

    return check


def _rows(rows: Sequence[views.WorkerView | views.RunView | views.LookaheadStep]) -> JSONResponse:
    return JSONResponse([dataclasses.asdict(row) for row in rows])
