"""Request for rewards in the format of OpenRLHF's remote reward model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from embomatrix.rpc.status import InvalidRequestError

MOST_ANSWERS: Final = 4096


@dataclass(frozen=True, slots=True)
class RewardAnswer:
    """Rewards in the order of the answers. A score is 1 for a success, else 0."""

    rewards: list[float]
    scores: list[float]
    extra_logs: dict[str, list[float]]
    """Rewards by tier: format, relevance and goal."""


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

    @classmethod
    def read(cls, body: bytes) -> Self:
        """Parse the body of a request. Raises InvalidRequestError."""
        try:
            return cls.model_validate_json(body)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False, include_context=False)[0]
            field = ".".join(map(str, first["loc"])) or "request"
            message = first["msg"].removeprefix("Value error, ")
            raise InvalidRequestError(
                f"{field}: {message}; expected a JSON object with query, prompts and labels"
            ) from error
