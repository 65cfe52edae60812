"""Work that any process with a copy of the policy can do: sample plans, score them, back-propagate a microbatch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from embomatrix.trainer.config.settings import GrpoSettings
from embomatrix.trainer.learning.likelihood import negative_log_likelihood
from embomatrix.trainer.learning.objective import LossInputs, LossMetrics, LossTotals, surrogate_loss
from embomatrix.trainer.policy.chat_rows import ChatRows
from embomatrix.trainer.policy.episode_rows import EpisodeRows
from embomatrix.trainer.policy.playing import rows_of_episodes
from embomatrix.trainer.policy.protocol import ImitationExample, Policy, Samples, Tokens


@dataclass(frozen=True, slots=True)
class Microbatch:
    """Part of a step that is back-propagated at once: ``prompts``, and one group of plans per prompt as rows.

    ``tokens``, ``mask``, ``old_logprobs``, ``sampler_logprobs`` and ``reference`` have shape (plans, tokens);
    ``advantages`` may have (plans, 1). ``totals`` holds the denominators of the loss.
    """

    prompts: Sequence[Tokens]
    tokens: Tensor
    mask: Tensor
    old_logprobs: Tensor
    sampler_logprobs: Tensor
    reference: Tensor | None
    advantages: Tensor
    totals: LossTotals


@dataclass(frozen=True, slots=True)
class SamplingParams:
    """Rule of sampling: ``group`` plans or episodes per prompt. A plan, or an answer in an episode, has at most ``max_new``
    tokens.
    """

    group: int
    temperature: float
    max_new: int

    @staticmethod
    def of(settings: GrpoSettings) -> SamplingParams:
        """Return the rule by which GRPO samples."""
        return SamplingParams(settings.group, settings.temperature, settings.max_new)


class Learner:
    """A policy in this process, and its reference policy, which GRPO needs and imitation doesn't."""

    def __init__(self, policy: Policy, reference: Policy | None, settings: GrpoSettings) -> None:
        self.policy = policy
        self.reference = reference
        self._settings = settings
        self._episodes: dict[int, EpisodeRows | ChatRows] = {}

    def sample(self, prompts: Sequence[Tokens], seed: int, rule: SamplingParams) -> Samples:
        """Draw plans for each prompt with a generator of this seed."""
        device = next(iter(self.policy.parameters())).device
        generator = torch.Generator(device).manual_seed(seed)
        return self.policy.sample(prompts, rule.group, rule.temperature, rule.max_new, generator)

    def begin_episodes(self, number: int, prompts: Sequence[Tokens], seed: int, rule: SamplingParams) -> None:
        """Begin the batch of episodes of this number, with ``rule.group`` for each prompt."""
        self._episodes[number] = rows_of_episodes(
            self.policy, prompts, rule.group, rule.temperature, seed, rule.max_new
        )

    def answer_episodes(
        self, number: int, rows: Sequence[int], observations: Sequence[str]
    ) -> list[str | None]:
        """Tell episodes of a batch what happened, unless they begin, and sample their answers.

        An answer is None if the policy has no room for another one.
        """
        episodes = self._episodes[number]
        if observations:
            episodes.observe(rows, observations)
        return episodes.answer(rows)

    def end_episodes(self, number: int) -> Samples:
        """Return all episodes of a batch as samples, and forget it."""
        return self._episodes.pop(number).samples()

    @torch.no_grad()
    def current_logprobs(self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor) -> Tensor:
        """Return log-probabilities (plans, tokens) under the policy."""
        settings = self._settings
        return self.policy.logprobs(prompts, tokens, mask, settings.group, settings.temperature).logprobs

    @torch.no_grad()
    def reference_logprobs(self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor) -> Tensor:
        """Return log-probabilities (plans, tokens) under the reference policy."""
        settings, reference = self._settings, self.reference
        assert reference is not None, "GRPO begins with a reference policy"
        return reference.logprobs(prompts, tokens, mask, settings.group, settings.temperature).logprobs

    def imitate(self, examples: Sequence[ImitationExample], tokens: int) -> float:
        """Add the gradient of the examples' loss to the gradients of the policy's parameters, and return the loss.

        ``tokens`` is the denominator: the plan tokens of the whole batch.
        """
        loss = negative_log_likelihood(self.policy, examples) / tokens
        torch.autograd.backward(loss)
        return float(loss.detach())

    def learn(self, microbatch: Microbatch) -> LossMetrics:
        """Add the microbatch's gradient to the gradients of the policy's parameters."""
        settings = self._settings
        scores = self.policy.logprobs(
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
