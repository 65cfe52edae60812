"""Label that a trainer sends beside each prompt when it requests rewards over HTTP."""

import json
from dataclasses import asdict
from typing import Annotated, Self

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from embomatrix.rpc.status import InvalidRequestError
from embomatrix.world.task import Profile

LARGEST_SEED = 2**32 - 1


@dataclass(frozen=True)
class RewardLabel:
    """Task, bundle, skill profile and seed of a rollout."""

    task_id: Annotated[str, Field(min_length=1)]
    bundle_digest: Annotated[str, Field(min_length=1)]
    profile: Profile
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)]

    def text(self) -> str:
        """Return the label as one line of JSON, for the label column of a dataset."""
        return json.dumps(asdict(self))

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse the JSON of ``text``. Raises InvalidRequestError."""
        try:
            return TypeAdapter(cls).validate_json(text)
        except ValidationError as error:
            first = error.errors(include_url=False, include_context=False)[0]
            field = ".".join(map(str, first["loc"])) or "label"
            raise InvalidRequestError(
                f"found the label {text[:80]!r} ({field}: {first['msg']}): expected a label that "
                "`trainer.adapters.openrlhf.rows` writes"
            ) from error


def answer_in(query: str, prompt: str) -> str:
    """Return the text after the prompt; tokenizers may have inserted text before it. Raises InvalidRequestError.

    The prompt shows an example plan, which must not be parsed as the answer. An empty prompt precedes any answer.
    """
    if not prompt:
        return query
    _, found, answer = query.partition(prompt)
    if not found:
        raise InvalidRequestError(
            f"the query {query[:80]!r} does not contain its prompt {prompt[:80]!r}: send both unchanged"
        )
    return answer
