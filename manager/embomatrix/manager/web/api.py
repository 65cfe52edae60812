"""The manager's HTTP port: the dashboard, the REST API that feeds it, and the metrics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fastapi import FastAPI
from fastapi.responses import Response

from embomatrix.manager.web.http_rules import Guard
from embomatrix.manager.web.page import page
from embomatrix.manager.web.prometheus import CONTENT_TYPE, metrics_page
from embomatrix.manager.web.rest import PREFIX, changing, reading
from embomatrix.manager.web.rest_tasks import showing
from embomatrix.manager.web.rewards import rewarding
from embomatrix.manager.web.snapshot import Snapshots
from embomatrix.rpc.versions import software_version

if TYPE_CHECKING:
    from embomatrix.manager.runtime.event_loop import ManagerRuntime
    from embomatrix.manager.services.expulsion import Expulsion
    from embomatrix.manager.web.gallery import Gallery
    from embomatrix.manager.web.http_rules import HttpRules
    from embomatrix.manager.web.no_gallery import NoGallery


def build_api(
    runtime: ManagerRuntime, rules: HttpRules, expulsion: Expulsion, gallery: Gallery | NoGallery
) -> FastAPI:
    """The application. With tokens, everything but the page's own files and the health check asks for one."""
    app = FastAPI(
        title="EmboMatrix manager",
        version=software_version() or "source",
        description="What a cluster does, an operator's verbs, rewards. With tokens: `Authorization: Bearer TOKEN`.",
        openapi_url=f"{PREFIX}/openapi.json",
        # Those of FastAPI load scripts from elsewhere.
        docs_url=None,
        redoc_url=None,
    )
    app.add_middleware(Guard, rules=rules)
    snapshots = Snapshots(runtime)
    app.include_router(page())
    app.include_router(reading(runtime, snapshots))
    app.include_router(showing(gallery))
    app.include_router(changing(runtime, snapshots, expulsion))
    app.include_router(rewarding(runtime.runs))

    @app.get("/healthz", include_in_schema=False)
    async def health() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/metrics", include_in_schema=False)
    async def metrics() -> Response:
        return Response(metrics_page(runtime), media_type=CONTENT_TYPE)

    return app
