"""What of a step any process can do that holds the policy: sample, score by the reference, back-propagate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch

from embomatrix.trainer.grpo.objective import LossMetrics, Scale, Terms, surrogate_loss

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from embomatrix.trainer.config.settings import GrpoSettings
    from embomatrix.trainer.policy.protocol import Policy, Samples, Tokens


@dataclass(frozen=True, slots=True)
class Lesson:
    """A part of a step to learn from: ``prompts`` of its tasks, and their plans as rows, a group after the other.

    ``tokens``, ``mask``, ``old_logprobs`` and ``reference`` have shape (plans, tokens), ``advantages`` (plans,). ``scale``
    holds the totals that the part's loss is divided by.
    """

    prompts: Sequence[Tokens]
    tokens: Tensor
    mask: Tensor
    old_logprobs: Tensor
    reference: Tensor | None
    advantages: Tensor
    scale: Scale


class Sampling(Protocol):
    """Who samples, here or in another process."""

    def sample(self, prompts: Sequence[Tokens], seed: int) -> Samples:
        """A group of plans for each prompt, drawn by a generator of this seed."""
        ...

    def of_reference(self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor) -> Tensor:
        """Log-probabilities (plans, tokens) of groups of plans under the reference policy."""
        ...


class Learner:
    """A policy with its reference, in this process."""

    def __init__(self, policy: Policy, reference: Policy, settings: GrpoSettings) -> None:
        self._policy = policy
        self._reference = reference
        self._settings = settings

    def sample(self, prompts: Sequence[Tokens], seed: int) -> Samples:
        settings = self._settings
        device = next(iter(self._policy.parameters())).device
        generator = torch.Generator(device).manual_seed(seed)
        return self._policy.sample(prompts, settings.group, settings.temperature, settings.max_new, generator)

    @torch.no_grad()
    def of_reference(self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor) -> Tensor:
        settings = self._settings
        return self._reference.logprobs(prompts, tokens, mask, settings.group, settings.temperature).logprobs

    def learn(self, lesson: Lesson) -> LossMetrics:
        """Back-propagate a part: its gradient is added to that of the policy's parameters."""
        settings = self._settings
        scored = self._policy.logprobs(
            lesson.prompts, lesson.tokens, lesson.mask, settings.group, settings.temperature
        )
        terms = Terms(
            logprobs=scored.logprobs,
            old_logprobs=lesson.old_logprobs,
            mask=lesson.mask,
            advantages=lesson.advantages,
            reference=lesson.reference,
            entropy=scored.entropy,
        )
        loss, metrics = surrogate_loss(terms, settings.objective(), lesson.scale)
        torch.autograd.backward(loss)
        return metrics
