"""REST API of the tasks of a dataset."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Final

from fastapi import APIRouter, Path, Query, Response

from embomatrix.manager.web.gallery_values import FloorPlanView, SceneName, TaskDetail, TaskPage
from embomatrix.manager.web.rest import PREFIX, Limit, Offset, json_response
from embomatrix.manager.web.rest_values import PAGE
from embomatrix.rpc.status import NotFoundError

if TYPE_CHECKING:
    from embomatrix.manager.web.gallery import Gallery

NO_DATASET: Final = "no dataset is shown: start the manager with --dataset FOLDER"
CARDS: Final = 24
"""Default number of tasks on a page."""
Words = Annotated[str, Query(max_length=200, description="Only tasks with these words.")]
Scene = Annotated[str, Query(max_length=256, description="Only tasks in this scene.")]
Category = Annotated[str, Query(max_length=64, description="Only tasks of this category.")]

TaskId = Annotated[str, Path(max_length=256, description="Id of the task, as lists show it.")]
Digest = Annotated[str, Path(max_length=256, description="Bundle digest of the scene, as `scenes` lists it.")]


def task_routes(gallery: Gallery | None) -> APIRouter:
    """Return the routes of viewers about tasks. ``gallery`` is None if the manager shows no dataset."""
    router = APIRouter(prefix=PREFIX, tags=["dataset"])

    @router.get("/tasks", response_model=TaskPage, summary="Tasks of the dataset")
    async def tasks(
        search: Words = "",
        scene: Scene = "",
        category: Category = "",
        offset: Offset = 0,
        limit: Limit = CARDS,
    ) -> Response:
        """Page of tasks in the order of the dataset, with the scenes and categories to filter by."""
        if gallery is None:
            return json_response(TaskPage(0, offset, [], [], [], NO_DATASET))
        return json_response(
            await gallery.page(search=search, scene=scene, category=category, offset=offset, limit=limit)
        )

    @router.get("/tasks/{task_id}", response_model=TaskDetail, summary="One task")
    async def task(task_id: TaskId) -> Response:
        """Instruction, objects, and the oracle's plan on the floor plan."""
        return json_response(await _shown(gallery).detail(task_id))

    @router.get("/scenes", response_model=list[SceneName], summary="Scenes of the dataset")
    async def scenes(offset: Offset = 0, limit: Limit = PAGE) -> Response:
        """Names of the dataset's scenes, by bundle digest."""
        if gallery is None:
            return json_response([])
        return json_response(await gallery.scenes(offset=offset, limit=limit))

    @router.get("/scenes/{digest}/floor", response_model=FloorPlanView, summary="Floor plan of a scene")
    async def floor(digest: Digest) -> Response:
        """Rooms, walls and furniture from above, in metres."""
        return json_response(await _shown(gallery).floor(digest))

    @router.get("/scenes/{digest}/picture", response_class=Response, summary="Picture of a scene")
    async def picture(digest: Digest) -> Response:
        """Rendering at an angle, as JPEG."""
        return Response(await _shown(gallery).picture(digest), media_type="image/jpeg")

    return router


def _shown(gallery: Gallery | None) -> Gallery:
    if gallery is None:
        raise NotFoundError(NO_DATASET)
    return gallery
