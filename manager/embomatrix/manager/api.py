"""The status page and its JSON: read only. Nothing here changes the cluster."""

from __future__ import annotations

import dataclasses
from importlib.resources import files
from typing import TYPE_CHECKING, Annotated

from fastapi import Depends, FastAPI, Header, HTTPException
from fastapi.middleware.trustedhost import TrustedHostMiddleware
from fastapi.responses import HTMLResponse, JSONResponse, PlainTextResponse

from embomatrix.manager import views
from embomatrix.manager.prometheus import metrics_page
from embomatrix.manager.service_auth import token_fits
from embomatrix.manager.settings import is_loopback

if TYPE_CHECKING:
    from collections.abc import Sequence

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

    def check(authorization: Annotated[str, Header()] = "") -> None:
        if settings.token and not token_fits(authorization, settings.token):
            raise HTTPException(401, "no token, or a wrong one: send `Authorization: Bearer TOKEN`")

    guarded = [Depends(check)]

    @app.get("/", response_class=HTMLResponse)
    def page() -> str:
        return files("embomatrix.manager").joinpath("dashboard/index.html").read_text(encoding="utf-8")

    @app.get("/healthz")
    async def health() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/api/overview", dependencies=guarded)
    async def overview() -> JSONResponse:
        return JSONResponse(dataclasses.asdict(views.overview(runtime)))

    @app.get("/api/workers", dependencies=guarded)
    async def workers() -> JSONResponse:
        return _rows(views.workers(runtime))

    @app.get("/api/runs", dependencies=guarded)
    async def runs() -> JSONResponse:
        return _rows(views.runs(runtime))

    @app.get("/api/lookahead", dependencies=guarded)
    async def lookahead() -> JSONResponse:
        return _rows(views.lookahead(runtime))

    @app.get("/metrics", dependencies=guarded, response_class=PlainTextResponse)
    async def metrics() -> str:
        return metrics_page(runtime)

    return app


def _rows(rows: Sequence[views.WorkerView | views.RunView | views.LookaheadStep]) -> JSONResponse:
    return JSONResponse([dataclasses.asdict(row) for row in rows])
