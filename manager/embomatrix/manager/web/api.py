"""HTTP application of the manager: the dashboard, its REST API, rewards, and Prometheus metrics."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping
from importlib.resources import files
from typing import TYPE_CHECKING, Final

from fastapi import Depends, FastAPI, HTTPException, Response
from fastapi.responses import FileResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.middleware.gzip import GZipMiddleware
from starlette.types import Scope

from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.revocation import Revocation
from embomatrix.manager.web.cluster_view import Snapshots
from embomatrix.manager.web.http_rules import STATIC, Guard, HttpRules
from embomatrix.manager.web.prometheus import CONTENT_TYPE, metrics_page
from embomatrix.manager.web.rest import (
    PREFIX,
    REFUSALS,
    answer_errors,
    command_routes,
    only_known_parameters,
    read_routes,
)
from embomatrix.manager.web.rest_runs import run_routes
from embomatrix.manager.web.rest_tasks import task_routes
from embomatrix.manager.web.rest_workers import worker_routes
from embomatrix.manager.web.rewards import reward_routes
from embomatrix.rpc.versions import software_version

if TYPE_CHECKING:
    from embomatrix.manager.web.gallery import Gallery

DASHBOARD: Final = str(files("embomatrix.manager.web") / "dashboard")
COMPRESSED_BYTES: Final = 1024
"""Smaller answers fit one packet and are sent as they are."""
TAGS: Final[Mapping[str, str]] = {
    "cluster": "health, figures, look-ahead, and the log of workers and scenes; for viewers",
    "runs": "open and closed runs, their timelines, and their training; for viewers",
    "workers": "workers, their machines and their logs; for viewers",
    "dataset": "tasks and scenes of the manager's dataset; for viewers",
    "commands": "drain, resume, expel, pause; for admins",
    "rewards": "rewards of answers; for trainers",
}
"""Groups of the API in the order of its page."""
PAGE_HEADERS: Final[Mapping[str, str]] = {
    # The chart library sets inline styles on its own elements; everything else comes from this server's files.
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    # Browsers revalidate the files, so that an upgrade shows at once.
    "cache-control": "no-cache",
}


def build_api(
    runtime: ManagerRuntime, rules: HttpRules, revocation: Revocation, gallery: Gallery | None
) -> FastAPI:
    """Return the application. If the manager asks for tokens, only the page's files and the health check need none."""
    app = FastAPI(
        title="EmboMatrix manager",
        version=software_version() or "source",
        description="State of the cluster, operator commands, and rewards. With tokens: `Authorization: Bearer TOKEN`.",
        # The route below makes the description in a thread, since the first time takes a tenth of a second of CPU.
        openapi_url=None,
        openapi_tags=[{"name": name, "description": text} for name, text in TAGS.items()],
        # FastAPI's own pages load scripts from other servers.
        docs_url=None,
        redoc_url=None,
    )
    answer_errors(app)
    app.add_middleware(GZipMiddleware, minimum_size=COMPRESSED_BYTES, compresslevel=1)
    app.add_middleware(Guard, rules=rules)
    app.mount(STATIC, _PageFiles(directory=DASHBOARD))
    snapshots = Snapshots(runtime)
    strictly = [Depends(only_known_parameters)]
    for routes in (
        read_routes(runtime, snapshots, rules.gate),
        worker_routes(runtime, snapshots),
        run_routes(runtime, snapshots, gallery),
        task_routes(gallery),
        command_routes(runtime, snapshots, revocation),
        reward_routes(runtime.runs),
    ):
        app.include_router(routes, dependencies=strictly, responses=REFUSALS)

    @app.get("/", include_in_schema=False)
    async def index() -> FileResponse:
        return FileResponse(f"{DASHBOARD}/index.html", headers=dict(PAGE_HEADERS))

    @app.get(f"{PREFIX}/openapi.json", include_in_schema=False)
    async def description() -> JSONResponse:
        return JSONResponse(await asyncio.to_thread(app.openapi))

    @app.get("/healthz", include_in_schema=False)
    async def health() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/metrics", include_in_schema=False)
    async def metrics() -> Response:
        return Response(metrics_page(runtime), media_type=CONTENT_TYPE)

    return app


class _PageFiles(StaticFiles):
    """Scripts and styles of the page, with its security headers."""

    def file_response(
        self,
        full_path: str | os.PathLike[str],
        stat_result: os.stat_result,
        scope: Scope,
        status_code: int = 200,
    ) -> Response:
        if not str(full_path).endswith((".js", ".css")):
            raise HTTPException(404)
        response = super().file_response(full_path, stat_result, scope, status_code)
        response.headers.update(PAGE_HEADERS)
        return response
