"""Label that a trainer sends beside each prompt when it requests rewards over HTTP."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Self

from embomatrix.rpc.status import InvalidRequestError
from embomatrix.world.task import Profile

LARGEST_SEED = 2**31 - 1


@dataclass(frozen=True, slots=True)
class RewardLabel:
    """Task, bundle, skill profile and seed of a rollout."""

    task_id: str
    bundle_digest: str
    profile: Profile
    seed: int

    def text(self) -> str:
        """Return the label as one line of JSON, for the label column of a dataset."""
        return json.dumps(asdict(self))

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse the JSON of ``text``. Raises InvalidRequestError."""
        try:
            value = json.loads(text)
            label = cls(
                task_id=_string(value["task_id"]),
                bundle_digest=_string(value["bundle_digest"]),
                profile=Profile(value["profile"]),
                seed=int(value["seed"]),
            )
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise InvalidRequestError(
                f"found the label {text[:80]!r} ({type(error).__name__}: {str(error)[:80]}): expected one that "
                "`trainer.adapters.openrlhf.rows` wrote"
            ) from error
        if not 0 <= label.seed <= LARGEST_SEED:
            raise InvalidRequestError(f"found the seed {label.seed} in a label: expected 0 to {LARGEST_SEED}")
        return label


def answer_in(query: str, prompt: str) -> str:
    """Return the text after the prompt; tokenizers may have inserted text before it. Raises InvalidRequestError.

    The prompt shows an example plan, which must not be parsed as the answer.
    """
    _, found, answer = query.partition(prompt)
    if not found:
        raise InvalidRequestError(
            f"the query {query[:80]!r} does not hold its prompt {prompt[:80]!r}: send both as they were"
        )
    return answer


def _string(value: object) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError(f"expected a text, found {value!r}")
    return value
