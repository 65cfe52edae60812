"""What a trainer that asks for rewards over HTTP carries beside each prompt: all that makes a rollout of an answer."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Self

from embomatrix.rpc.status import InvalidRequestError
from embomatrix.world.task import Profile

LARGEST_SEED = 2**31 - 1


@dataclass(frozen=True, slots=True)
class RewardLabel:
    """A task in its scene, the skills that plans for it may use, and the seed that its rollouts share."""

    task_id: str
    bundle_digest: str
    profile: Profile
    seed: int

    def text(self) -> str:
        """As JSON in one line, for the label column of a trainer's dataset."""
        return json.dumps(asdict(self))

    @classmethod
    def parse(cls, text: str) -> Self:
        """The inverse of ``text``. Raises InvalidRequestError."""
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
    """What was written after the prompt; tokenizers may have put a mark before it. Raises InvalidRequestError.

    The prompt shows a plan as an example, which must not be taken for an answer.
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
