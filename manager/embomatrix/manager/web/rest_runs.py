"""REST API of runs: open and closed ones, their timelines, and their training."""

from typing import Annotated, Final

from fastapi import APIRouter, Path, Query, Response

from embomatrix.manager.observe.training_reports import TrainingDetail, TrainingView
from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.web.cluster_view import Snapshots
from embomatrix.manager.web.rest import PREFIX, Limit, Offset, Search, json_response
from embomatrix.manager.web.rest_values import (
    PAGE,
    RunDetail,
    RunFilter,
    RunPage,
    Timeline,
    run_detail,
    run_page,
    timeline,
)

LONGEST_S: Final = 3600.0
RunId = Annotated[
    str, Path(max_length=256, description="Id of the run, as `runs` lists it.", examples=["run-5f2a"])
]
Shown = Annotated[
    RunFilter, Query(alias="state", description="Open runs, closed runs that are kept, or all.")
]
Words = Annotated[str, Query(max_length=64, description="Only runs with this text in their name or id.")]
Seconds = Annotated[float, Query(gt=0, le=LONGEST_S, description="Length of the interval, in seconds.")]


def run_routes(runtime: ManagerRuntime, snapshots: Snapshots) -> APIRouter:
    """Return the routes of viewers about runs."""
    router = APIRouter(prefix=PREFIX, tags=["runs"])
    history = runtime.history

    @router.get("/runs", response_model=RunPage, summary="Runs by name")
    async def runs(
        shown: Shown = RunFilter.OPEN, search: Words = "", offset: Offset = 0, limit: Limit = PAGE
    ) -> Response:
        """Page of the open runs, newest first, then of the last 50 closed ones, the last closed first."""
        closed = [] if shown is RunFilter.OPEN else await history.kept()
        page = run_page(snapshots.now(), closed, shown=shown, search=search, offset=offset, limit=limit)
        return json_response(page)

    @router.get("/runs/{run_id}", response_model=RunDetail, summary="One run")
    async def run(run_id: RunId) -> Response:
        """Story in sentences, totals, durations by phase, work of each worker, and latest failures; open or closed."""
        summary = await history.summary(run_id)
        return json_response(run_detail(summary, await history.find_training(run_id)))

    @router.get("/runs/{run_id}/timeline", response_model=Timeline, summary="Work of each slot of a run")
    async def tracks(run_id: RunId, seconds: Seconds = 60.0, search: Search = "") -> Response:
        """Work and idle time of each slot in the last seconds of the run, on workers with the text in their name."""
        latest = await history.latest(run_id, seconds)
        return json_response(timeline(run_id, latest, seconds=seconds, search=search))

    @router.get("/training", response_model=list[TrainingView], summary="Runs whose trainers report")
    async def reporting() -> Response:
        """Runs with learning curves in memory, latest report first. Includes some closed runs."""
        return json_response(snapshots.now().training)

    @router.get(
        "/training/{run_id}", response_model=TrainingDetail, summary="Learning curves and plans of a run"
    )
    async def detail(run_id: RunId) -> Response:
        """Figures of each step by phase, and recent plans of the policy with the result of each call; open or closed."""
        return json_response(await history.training(run_id))

    return router
