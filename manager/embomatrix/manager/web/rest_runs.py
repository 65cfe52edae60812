"""REST API of runs: open and closed ones, their timelines, and their training."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Final

from fastapi import APIRouter, Path, Query, Response

from embomatrix.manager.observe.training_reports import TrainingDetail, TrainingView
from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.web.cluster_view import Snapshots
from embomatrix.manager.web.gallery_values import SampledPlanView
from embomatrix.manager.web.rest import PREFIX, SEARCH_CHARS, Limit, Offset, Search, json_response
from embomatrix.manager.web.rest_tasks import NO_DATASET
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
from embomatrix.rpc.status import NotFoundError, UnavailableError

if TYPE_CHECKING:
    from embomatrix.manager.web.gallery import Gallery

LONGEST_S: Final = 3600.0
PlanNumber = Annotated[int, Path(description="Place of the plan among the reported ones, from 1.")]
RunId = Annotated[
    str, Path(max_length=256, description="Id of the run, as `runs` lists it.", examples=["run-5f2a"])
]
Shown = Annotated[
    RunFilter, Query(alias="state", description="Open runs, closed runs that are kept, or all.")
]
Words = Annotated[
    str, Query(max_length=SEARCH_CHARS, description="Only runs with this text in their name or id.")
]
Seconds = Annotated[float, Query(gt=0, le=LONGEST_S, description="Length of the interval, in seconds.")]


def run_routes(runtime: ManagerRuntime, snapshots: Snapshots, gallery: Gallery | None) -> APIRouter:
    """Return the routes of viewers about runs. ``gallery`` is None if the manager shows no dataset."""
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

    @router.get(
        "/training/{run_id}/plans/{number}",
        response_model=SampledPlanView,
        summary="One recent plan or episode of a run",
    )
    async def plan(run_id: RunId, number: PlanNumber) -> Response:
        """Text of the policy and what became of it, call by call on the floor plan; of an episode also each observation."""
        training = await history.training(run_id)
        count = len(training.plans)
        if not 1 <= number <= count:
            raise NotFoundError(
                f"the trainer of run {run_id} reported {count} plans with step {training.plans_step}, expected a number from 1 "
                f"to {count}, found {number}"
                if count
                else f"the trainer of run {run_id} has reported no plan yet: look again after its first step"
            )
        sampled = training.plans[number - 1]
        view = SampledPlanView(training.plans_step, number, count, sampled)
        return json_response(await _with_task(view, gallery))

    return router


async def _with_task(view: SampledPlanView, gallery: Gallery | None) -> SampledPlanView:
    if gallery is None:
        return replace(view, notice=NO_DATASET)
    try:
        return replace(view, task=await gallery.detail(view.plan.task_id, view.plan.steps))
    except (NotFoundError, UnavailableError) as error:
        return replace(view, notice=str(error))
