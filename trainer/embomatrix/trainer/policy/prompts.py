"""Prompts of tasks for a policy, in the policy's codec."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

from embomatrix.skills.parse import plan_to_json, plan_to_lines
from embomatrix.skills.prompt import Codec, Situation, limited, plan_in_names, prompt_for, subset
from embomatrix.skills.syntax import Plan
from embomatrix.trainer.data.variation import Variation, drop_bystanders, used_rows, vary
from embomatrix.trainer.policy.protocol import ImitationExample

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.policy.protocol import Policy, Tokens


@dataclass(frozen=True, slots=True)
class TaskPrompt:
    """A task's prompt. ``situation`` is the prompt's content, which also resolves the names in plans that answer it."""

    situation: Situation
    tokens: Tokens


class Examples(Protocol):
    """Source of the examples of imitation."""

    def example(self, task: TrainingTask, rng: np.random.Generator) -> ImitationExample:
        """Return a task's example, perhaps varied."""
        ...

    def plain_example(self, task: TrainingTask) -> ImitationExample:
        """Return a task's unvaried example, for the validation loss."""
        ...


@dataclass(frozen=True, slots=True)
class PromptBuilder:
    """Builds prompts with at most ``rows`` object rows for one policy. Only training varies them.

    GRPO has its own rename share: imitation must learn to read object properties, but GRPO practises on the words of the
    evaluation.
    """

    policy: Policy
    rows: int
    variation: Variation
    practice_rename: float = 0.0

    def plain(self, task: TrainingTask) -> TaskPrompt:
        """Return the unvaried prompt, for evaluation."""
        return self._build(limited(task.situation, self.rows))

    def varied(self, task: TrainingTask, rng: np.random.Generator) -> TaskPrompt:
        """Return a randomly varied prompt for GRPO. A whole group shares it."""
        variation = replace(self.variation, rename=self.practice_rename)
        return self._build(vary(limited(task.situation, self.rows), variation, rng))

    def example(self, task: TrainingTask, rng: np.random.Generator) -> ImitationExample:
        """Return a randomly varied prompt and the oracle plan, for imitation."""
        situation = drop_bystanders(self._with_needed(task), used_rows(task.oracle), self.variation.drop, rng)
        return self._example(task, vary(situation, self.variation, rng))

    def plain_example(self, task: TrainingTask) -> ImitationExample:
        """Return the unvaried prompt and the oracle plan, for the validation loss."""
        return self._example(task, self._with_needed(task))

    def _with_needed(self, task: TrainingTask) -> Situation:
        """Return the limited situation plus the rows that the oracle plan uses."""
        kept = {row.index for row in limited(task.situation, self.rows).rows}
        return subset(task.situation, kept | used_rows(task.oracle))

    def _example(self, task: TrainingTask, situation: Situation) -> ImitationExample:
        text = plan_text(task.oracle, situation, self.policy.codec)
        return ImitationExample(self._build(situation).tokens, self.policy.encode_plan(text))

    def _build(self, situation: Situation) -> TaskPrompt:
        return TaskPrompt(situation, self.policy.encode(prompt_for(situation, self.policy.codec)))


def plan_text(plan: Plan, situation: Situation, codec: Codec) -> str:
    """Write a plan in the policy's codec."""
    if codec is Codec.NAMES:
        return plan_in_names(plan, situation)
    return plan_to_lines(plan) if codec is Codec.LINES else json.dumps(plan_to_json(plan))
