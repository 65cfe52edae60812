"""Rewards over HTTP, in the request format of OpenRLHF's remote reward model.

Each request is one batch of a run that all such requests share, and waits until every answer has its reward.
"""

from __future__ import annotations

import asyncio
import hashlib
import secrets
from collections.abc import Mapping, Sequence
from typing import Annotated, Final

from fastapi import APIRouter, Query, Request
from fastapi.responses import JSONResponse

from embomatrix.manager.runtime.results import BatchLog
from embomatrix.manager.runtime.runs import Runs
from embomatrix.manager.web.bodies import BodyBudget
from embomatrix.manager.web.parsing import Answer, AnswerParser
from embomatrix.manager.web.rest import PREFIX
from embomatrix.manager.web.reward_request import RewardAnswer, RewardRequest
from embomatrix.proto.v1 import types_pb2
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.hierarchy import unparsable as score_of_no_plan
from embomatrix.reward.settings import PAPER, RewardSettings, RewardSettingsError
from embomatrix.rpc.status import InvalidRequestError, UnavailableError
from embomatrix.rpc.wire.outcome import rollout_result_from_proto
from embomatrix.rpc.wire.values import Batch, Completed, GroupPolicy, Outcome, Rollout, RunTerms

REWARDS: Final = f"{PREFIX}/rewards"
RUN_ID: Final = "http-rewards"
LONGEST_S: Final = 170.0
"""OpenRLHF's client repeats a request after 180 s."""
_Coefficient = Annotated[float, Query(description="Coefficient of the reward; by default the paper's.")]


def reward_routes(runs: Runs) -> APIRouter:
    """Return the routes of trainers."""
    router = APIRouter(prefix=PREFIX, tags=["rewards"])
    bodies, parser = BodyBudget(), AnswerParser()

    @router.post(
        "/rewards",
        summary="Rewards of answers",
        response_model=RewardAnswer,
        openapi_extra={"requestBody": _BODY},
    )
    async def rewards(
        request: Request,
        unparsable: _Coefficient = PAPER.unparsable,
        format: _Coefficient = PAPER.format,
        relevance_per_object: _Coefficient = PAPER.relevance_per_object,
        relevance_limit: _Coefficient = PAPER.relevance_limit,
        goal: _Coefficient = PAPER.goal,
    ) -> JSONResponse:
        """Reward, success (as score) and tiers of each answer; 503 after an infrastructure failure."""
        try:
            settings = RewardSettings(unparsable, format, relevance_per_object, relevance_limit, goal)
        except RewardSettingsError as error:
            raise InvalidRequestError(str(error)) from error
        body = await bodies.receive(request)
        try:
            answers = await parser.parse(body)
        finally:
            bodies.release(request, len(body))
        return JSONResponse(_response(await _rewards(runs, answers, settings)))

    return router


_BODY: Final = {"content": {"application/json": {"schema": RewardRequest.model_json_schema()}}}


async def _rewards(runs: Runs, answers: Sequence[Answer], settings: RewardSettings) -> list[RewardBreakdown]:
    """Return the rewards in the order of the answers. Unparsable answers are scored here and never executed."""
    run_id, batch_id = run_of(settings), secrets.token_hex(8)
    found: dict[int, RewardBreakdown] = {}
    rollouts: dict[int, Rollout] = {}
    for index, (label, plan) in enumerate(answers):
        if plan is None:
            found[index] = score_of_no_plan(settings)
            continue
        group = f"{run_id}/{batch_id}/{label.task_id}"
        rollouts[index] = Rollout(
            f"{run_id}/{batch_id}/{index}", group, label.bundle_digest, label.task_id, plan, label.seed
        )
    if rollouts:
        batch = Batch(run_id, batch_id, 0, tuple(rollouts.values()))
        outcomes = await _executed(runs, batch, settings)
        for index, rollout in rollouts.items():
            found[index] = _reward(outcomes.get(rollout.rollout_id))
    return [found[index] for index in range(len(answers))]


def run_of(settings: RewardSettings) -> str:
    """Return the id of the run that all requests with these coefficients share."""
    if settings == PAPER:
        return RUN_ID
    return f"{RUN_ID}-{hashlib.sha256(repr(settings).encode()).hexdigest()[:8]}"


async def _executed(runs: Runs, batch: Batch, settings: RewardSettings) -> dict[str, Outcome]:
    """Return the outcome of each rollout. Cancel the batch on timeout, or if the client disconnects."""
    await runs.open_run("rewards over HTTP", batch.run_id, RunTerms(GroupPolicy.PARTIAL, reward=settings))
    log = await runs.submit(batch)
    try:
        async with asyncio.timeout(LONGEST_S):
            return await _read(log)
    except TimeoutError as error:
        raise UnavailableError(
            f"{len(batch.rollouts)} answers need more than {LONGEST_S:g} s: send fewer per request, or add workers"
        ) from error
    finally:
        if not log.ended:
            runs.cancel(batch.run_id, batch.batch_id)


async def _read(log: BatchLog) -> dict[str, Outcome]:
    outcomes: dict[str, Outcome] = {}
    async for rows in log.messages(0):
        for row in rows:
            result = rollout_result_from_proto(types_pb2.RolloutResult.FromString(row.payload))
            outcomes[result.rollout_id] = result.outcome
    return outcomes


def _reward(outcome: Outcome | None) -> RewardBreakdown:
    if not isinstance(outcome, Completed):
        raise UnavailableError(
            "a rollout ended in an infrastructure failure and has no reward: send the request again"
        )
    return outcome.reward


def _response(rewards: Sequence[RewardBreakdown]) -> Mapping[str, object]:
    return {
        "rewards": [reward.total for reward in rewards],
        "scores": [float(reward.success) for reward in rewards],
        "extra_logs": {
            name: [reward.tiers[name] for reward in rewards] for name in ("format", "relevance", "goal")
        },
    }
