"""How tasks are told to a policy: which rows, in which words, in the policy's own codec."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from embomatrix.skills.parse import plan_to_json, plan_to_lines
from embomatrix.skills.prompt import Codec, limited, plan_in_names, prompt_for, subset
from embomatrix.trainer.data.variation import Variation, used_rows, varied, with_fewer_bystanders

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.skills.prompt import Situation
    from embomatrix.skills.syntax import Plan
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.policy.protocol import Policy, Tokens


@dataclass(frozen=True, slots=True)
class Told:
    """A task as told once: the situation behind the prompt also reads the names in the plans that answer it."""

    situation: Situation
    prompt: Tokens


@dataclass(frozen=True, slots=True)
class Teller:
    """Tells tasks to one policy; ``rows`` at most, varied during training only.

    GRPO has a share of renaming of its own: where imitation is to learn to go by what is said of a thing, GRPO practises what
    it will be examined in.
    """

    policy: Policy
    rows: int
    variation: Variation
    practice_rename: float = 0.0

    def plainly(self, task: TrainingTask) -> Told:
        """The task as it is: evaluation."""
        return self._told(limited(task.situation, self.rows))

    def anew(self, task: TrainingTask, rng: np.random.Generator) -> Told:
        """The task in one of its many tellings: GRPO. One telling serves a whole group."""
        variation = replace(self.variation, rename=self.practice_rename)
        return self._told(varied(limited(task.situation, self.rows), variation, rng))

    def lesson(self, task: TrainingTask, rng: np.random.Generator) -> tuple[Tokens, Tokens]:
        """Prompt and oracle's plan of one telling: imitation."""
        situation = with_fewer_bystanders(
            self._with_needed(task), used_rows(task.oracle), self.variation.drop, rng
        )
        return self._lesson(task, varied(situation, self.variation, rng))

    def plain_lesson(self, task: TrainingTask) -> tuple[Tokens, Tokens]:
        """The same, of the task as it is: what imitation is measured by."""
        return self._lesson(task, self._with_needed(task))

    def _with_needed(self, task: TrainingTask) -> Situation:
        """What is told of a task, and what its oracle uses besides."""
        told = {row.index for row in limited(task.situation, self.rows).rows}
        return subset(task.situation, told | used_rows(task.oracle))

    def _lesson(self, task: TrainingTask, situation: Situation) -> tuple[Tokens, Tokens]:
        text = plan_text(task.oracle, situation, self.policy.codec)
        return self._told(situation).prompt, self.policy.encode_plan(text)

    def _told(self, situation: Situation) -> Told:
        return Told(situation, self.policy.encode(prompt_for(situation, self.policy.codec)))


def plan_text(plan: Plan, situation: Situation, codec: Codec) -> str:
    """The plan as a policy of this codec should write it."""
    if codec is Codec.NAMES:
        return plan_in_names(plan, situation)
    return plan_to_lines(plan) if codec is Codec.LINES else json.dumps(plan_to_json(plan))
