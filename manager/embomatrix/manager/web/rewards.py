"""Rewards over HTTP, in the request format of OpenRLHF's remote reward model.

Each request is one batch of a run that all such requests share, and waits until every answer has its reward.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Mapping, Sequence
from typing import Final

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse

from embomatrix.manager.runtime.results import BatchLog
from embomatrix.manager.runtime.runs import Runs
from embomatrix.manager.web.bodies import BodyBudget
from embomatrix.manager.web.parsing import Answer, AnswerParser
from embomatrix.manager.web.rest import PREFIX
from embomatrix.manager.web.reward_request import RewardAnswer, RewardRequest
from embomatrix.proto.v1 import types_pb2
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.hierarchy import unparsable
from embomatrix.rpc.status import UnavailableError
from embomatrix.rpc.wire.outcome import rollout_result_from_proto
from embomatrix.rpc.wire.values import Batch, Completed, GroupPolicy, Outcome, Rollout, RunTerms

REWARDS: Final = f"{PREFIX}/rewards"
RUN_ID: Final = "http-rewards"
TERMS: Final = RunTerms(GroupPolicy.PARTIAL)
LONGEST_S: Final = 170.0
"""OpenRLHF's client repeats a request after 180 s."""


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
    async def rewards(request: Request) -> JSONResponse:
        """Reward, success (as score) and tiers of each answer; 503 after an infrastructure failure."""
        body = await bodies.receive(request)
        try:
            answers = await parser.parse(body)
        finally:
            bodies.release(request, len(body))
        return JSONResponse(_response(await _rewards(runs, answers)))

    return router


_BODY: Final = {"content": {"application/json": {"schema": RewardRequest.model_json_schema()}}}


async def _rewards(runs: Runs, answers: Sequence[Answer]) -> list[RewardBreakdown]:
    """Return the rewards in the order of the answers. Unparsable answers are scored here and never executed."""
    batch_id = secrets.token_hex(8)
    found: dict[int, RewardBreakdown] = {}
    rollouts: dict[int, Rollout] = {}
    for index, (label, plan) in enumerate(answers):
        if plan is None:
            found[index] = unparsable()
            continue
        group = f"{RUN_ID}/{batch_id}/{label.task_id}"
        rollouts[index] = Rollout(
            f"{RUN_ID}/{batch_id}/{index}", group, label.bundle_digest, label.task_id, plan, label.seed
        )
    if rollouts:
        batch = Batch(RUN_ID, batch_id, 0, tuple(rollouts.values()))
        outcomes = await _executed(runs, batch)
        for index, rollout in rollouts.items():
            found[index] = _reward(outcomes.get(rollout.rollout_id))
    return [found[index] for index in range(len(answers))]


async def _executed(runs: Runs, batch: Batch) -> dict[str, Outcome]:
    """Return the outcome of each rollout. Cancel the batch on timeout, or if the client disconnects."""
    await runs.open_run("rewards over HTTP", RUN_ID, TERMS)
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
