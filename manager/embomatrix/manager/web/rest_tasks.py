"""The REST API of the dataset that the manager was told of: its tasks in pages, each with everything about it."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import JSONResponse

from embomatrix.manager.web.gallery_values import FloorPlanView, SceneName, TaskDetail, TaskPage
from embomatrix.manager.web.packing import packed
from embomatrix.manager.web.rest import PREFIX, Limit, Offset, answered
from embomatrix.manager.web.rest_values import PAGE

if TYPE_CHECKING:
    from embomatrix.manager.web.gallery import Gallery
    from embomatrix.manager.web.no_gallery import NoGallery

CARDS = 24
Words = Annotated[str, Query(max_length=200, description="Only tasks with these words.")]
Scene = Annotated[str, Query(max_length=256, description="Only tasks in this scene.")]
Category = Annotated[str, Query(max_length=64, description="Only tasks of this category.")]


def showing(gallery: Gallery | NoGallery) -> APIRouter:
    """What a viewer may ask about tasks."""
    router = APIRouter(prefix=PREFIX, tags=["tasks"])

    @router.get("/tasks", response_model=TaskPage)
    async def tasks(
        search: Words = "",
        scene: Scene = "",
        category: Category = "",
        offset: Offset = 0,
        limit: Limit = CARDS,
    ) -> Response:
        """Tasks of the dataset, in its order."""
        with answered():
            found = await gallery.page(
                search=search, scene=scene, category=category, offset=offset, limit=limit
            )
        return JSONResponse(dataclasses.asdict(found))

    @router.get("/tasks/{task_id}", response_model=TaskDetail)
    async def task(request: Request, task_id: str) -> Response:
        """One task: what is asked, its objects, and the oracle's plan on the plan view."""
        with answered():
            return _json(request, await gallery.detail(task_id))

    _scenes(router, gallery)
    return router


def _scenes(router: APIRouter, gallery: Gallery | NoGallery) -> None:
    @router.get("/scenes", response_model=list[SceneName])
    async def scenes(request: Request, offset: Offset = 0, limit: Limit = PAGE) -> Response:
        """What the scenes of the dataset are called, by the digests of their bundles."""
        with answered():
            return _json(request, await gallery.scenes(offset=offset, limit=limit))

    @router.get("/scenes/{digest}/floor", response_model=FloorPlanView)
    async def floor(request: Request, digest: str) -> Response:
        """A scene from above."""
        with answered():
            return _json(request, await gallery.floor(digest))

    @router.get("/scenes/{digest}/picture", response_class=Response)
    async def picture(digest: str) -> Response:
        """A scene at an angle, as a JPEG."""
        with answered():
            return Response(await gallery.picture(digest), media_type="image/jpeg")


def _json(request: Request, value: TaskDetail | FloorPlanView | list[SceneName]) -> Response:
    told = json.dumps(value, default=dataclasses.asdict, separators=(",", ":"))
    return packed(request, told.encode())
