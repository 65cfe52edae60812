"""Rewards over HTTP, in the request format of OpenRLHF's remote reward model.

Each request is one batch of a run that all such requests share, and waits until every answer has its reward.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Mapping, Sequence
from typing import Final

from fastapi import APIRouter, HTTPException, Request
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from embomatrix.manager.runtime.results import BatchLog
from embomatrix.manager.runtime.runs import Runs
from embomatrix.manager.web.rest import PREFIX
from embomatrix.proto.v1 import types_pb2
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.hierarchy import unparsable
from embomatrix.rpc.reward_label import RewardLabel, answer_in
from embomatrix.rpc.status import InvalidRequestError, UnavailableError
from embomatrix.rpc.wire.outcome import rollout_result_from_proto
from embomatrix.rpc.wire.values import Batch, Completed, GroupPolicy, Outcome, Rollout, RunTerms
from embomatrix.skills.parse import PlanError, parse_plan

REWARDS: Final = f"{PREFIX}/rewards"
RUN_ID: Final = "http-rewards"
TERMS: Final = RunTerms(GroupPolicy.PARTIAL)
LARGEST_BYTES: Final = 64 * 1024 * 1024
MOST_ANSWERS: Final = 4096
LONGEST_S: Final = 170.0
"""OpenRLHF's client repeats a request after 180 s."""


class RewardRequest(BaseModel):
    """Request of OpenRLHF. ``query`` is the prompt followed by the answer; unknown fields are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")
    query: list[str] = Field(min_length=1, max_length=MOST_ANSWERS)
    prompts: list[str]
    """Prompts without answers. They keep the example plan in a prompt from being parsed as the answer."""
    labels: list[str]
    """``RewardLabel`` of each answer, as text."""

    @model_validator(mode="after")
    def _as_many(self) -> RewardRequest:
        if not len(self.query) == len(self.prompts) == len(self.labels):
            raise ValueError(
                f"found {len(self.query)} queries, {len(self.prompts)} prompts and {len(self.labels)} labels: "
                "send the same number of each"
            )
        return self


def reward_routes(runs: Runs) -> APIRouter:
    """Return the routes of trainers."""
    router = APIRouter(prefix=PREFIX, tags=["train"])

    @router.post("/rewards", openapi_extra={"requestBody": _BODY})
    async def rewards(request: Request) -> JSONResponse:
        """Reward, success (as score) and tiers of each answer; 503 after an infrastructure failure."""
        requested = _request(await _body(request))
        return JSONResponse(_response(await _rewards(runs, requested)))

    return router


_BODY: Final = {"content": {"application/json": {"schema": RewardRequest.model_json_schema()}}}


async def _body(request: Request) -> bytes:
    """Return the body. Raise HTTP 413 above ``LARGEST_BYTES``, since uvicorn has no limit."""
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > LARGEST_BYTES:
            raise HTTPException(413, f"more than {LARGEST_BYTES >> 20} MiB: send fewer answers at once")
    return bytes(body)


def _request(body: bytes) -> RewardRequest:
    try:
        return RewardRequest.model_validate_json(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        field = ".".join(map(str, first["loc"])) or "request"
        message = first["msg"].removeprefix("Value error, ")
        raise InvalidRequestError(
            f"{field}: {message}; expected a JSON object with query, prompts and labels"
        ) from error


async def _rewards(runs: Runs, requested: RewardRequest) -> list[RewardBreakdown]:
    """Return the rewards in the order of the answers. Unparsable answers are scored here and never executed."""
    batch_id = secrets.token_hex(8)
    found: dict[int, RewardBreakdown] = {}
    rollouts: dict[int, Rollout] = {}
    for index, label in enumerate(map(RewardLabel.parse, requested.labels)):
        try:
            plan = parse_plan(answer_in(requested.query[index], requested.prompts[index]), label.profile)
        except PlanError:
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
    return [found[index] for index in range(len(requested.query))]


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
