"""What viewers are told of tasks where the manager was told of no dataset.

It reads no scenes, so it needs no numpy: the manager's image has none, and passes bundles on as bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.manager.web.gallery_values import TaskPage
from embomatrix.rpc.status import NotFoundError

if TYPE_CHECKING:
    from embomatrix.manager.web.gallery_values import FloorPlanView, SceneName, TaskDetail

NO_DATASET: Final = "no dataset is shown: start the manager with --dataset FOLDER"


class NoGallery:
    """Answers as a gallery does; NotFoundError for each single thing."""

    async def page(self, *, search: str, scene: str, category: str, offset: int, limit: int) -> TaskPage:
        """An empty one with the reason."""
        return TaskPage(0, offset, [], [], [], NO_DATASET)

    async def scenes(self, *, offset: int, limit: int) -> list[SceneName]:
        """None: bundles go by their digests."""
        return []

    async def detail(self, task_id: str) -> TaskDetail:
        raise NotFoundError(NO_DATASET)

    async def floor(self, digest: str) -> FloorPlanView:
        raise NotFoundError(NO_DATASET)

    async def picture(self, digest: str) -> bytes:
        raise NotFoundError(NO_DATASET)
