"""Work on one microbatch that any process with a copy of the policy can do: sample, score, back-propagate."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from embomatrix.trainer.config.settings import GrpoSettings
from embomatrix.trainer.grpo.objective import LossInputs, LossMetrics, LossTotals, surrogate_loss
from embomatrix.trainer.policy.protocol import Policy, Samples, Tokens


@dataclass(frozen=True, slots=True)
class Microbatch:
    """Part of a step that is back-propagated at once: ``prompts``, and one group of plans per prompt as rows.

    ``tokens``, ``mask``, ``old_logprobs``, ``sampler_logprobs`` and ``reference`` have shape (plans, tokens);
    ``advantages`` has (plans,). ``totals`` holds the denominators of the loss.
    """

    prompts: Sequence[Tokens]
    tokens: Tensor
    mask: Tensor
    old_logprobs: Tensor
    sampler_logprobs: Tensor
    reference: Tensor | None
    advantages: Tensor
    totals: LossTotals


class Learner:
    """A policy and its reference policy in this process."""

    def __init__(self, policy: Policy, reference: Policy, settings: GrpoSettings) -> None:
        self._policy = policy
        self._reference = reference
        self._settings = settings

    def sample(self, prompts: Sequence[Tokens], seed: int) -> Samples:
        """Draw a group of plans per prompt with a generator of this seed."""
        settings = self._settings
        device = next(iter(self._policy.parameters())).device
        generator = torch.Generator(device).manual_seed(seed)
        return self._policy.sample(prompts, settings.group, settings.temperature, settings.max_new, generator)

    @torch.no_grad()
    def current_logprobs(self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor) -> Tensor:
        """Return log-probabilities (plans, tokens) under the policy."""
        settings = self._settings
        return self._policy.logprobs(prompts, tokens, mask, settings.group, settings.temperature).logprobs

    @torch.no_grad()
    def reference_logprobs(self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor) -> Tensor:
        """Return log-probabilities (plans, tokens) under the reference policy."""
        settings = self._settings
        return self._reference.logprobs(prompts, tokens, mask, settings.group, settings.temperature).logprobs

    def learn(self, microbatch: Microbatch) -> LossMetrics:
        """Add the microbatch's gradient to the gradients of the policy's parameters."""
        settings = self._settings
        scores = self._policy.logprobs(
            microbatch.prompts,
            microbatch.tokens,
            microbatch.mask,
            settings.group,
            settings.temperature,
            entropy_gradient=settings.entropy_coef > 0,
        )
        inputs = LossInputs(
            logprobs=scores.logprobs,
            old_logprobs=microbatch.old_logprobs,
            mask=microbatch.mask,
            advantages=microbatch.advantages,
            reference=microbatch.reference,
            entropy=scores.entropy,
            sampler_logprobs=microbatch.sampler_logprobs,
        )
        loss, metrics = surrogate_loss(inputs, settings, microbatch.totals)
        torch.autograd.backward(loss)
        return metrics
