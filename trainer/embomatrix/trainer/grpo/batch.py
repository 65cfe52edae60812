"""Scored groups of a step: their advantages, and their division into minibatches and microbatches."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from embomatrix.trainer.config.settings import GrpoSettings, LossKind, OnLost
from embomatrix.trainer.grpo.records import GroupLog
from embomatrix.trainer.learning.learner import Microbatch
from embomatrix.trainer.learning.objective import LossTotals, group_advantages
from embomatrix.trainer.policy.protocol import Tokens, written_lengths

if TYPE_CHECKING:
    from embomatrix.trainer.cluster.gateway import PlanOutcome
    from embomatrix.trainer.grpo.sampling import SampledChunk

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class ScoredGroup:
    """Plans of one task as rows, with their advantages. Tensors have shape (G, tokens), ``advantages`` may have (G, 1).

    ``mask`` is true on tokens in the loss: not on those of lost plans, nor of plans that ``Overlong.MASK`` leaves out.
    ``longest`` counts the tokens up to the end of the longest plan, ``counted`` those of the group in the denominator of the
    loss. ``learns`` is false for groups without a gradient.
    """

    log: GroupLog
    prompt: Tokens
    tokens: Tensor
    mask: Tensor
    old_logprobs: Tensor
    sampler_logprobs: Tensor
    reference: Tensor | None
    advantages: Tensor
    longest: int
    counted: int
    learns: bool


def scored_groups(
    chunk: SampledChunk,
    outcomes: Sequence[tuple[PlanOutcome, ...]],
    settings: GrpoSettings,
    relevance: float,
) -> list[ScoredGroup]:
    """Return the groups of a chunk with their advantages. ``relevance`` weights the reward's relevance tier.

    Zero-variance groups learn if the settings keep their KL and entropy terms. Groups learn nothing without a plan in the
    loss.
    """
    samples, group = chunk.samples, settings.group
    shape = (len(chunk.tasks), group)
    rewards = torch.tensor(
        [[outcome.weighted_reward(relevance) for outcome in plans] for plans in outcomes]
    )  # (tasks, G)
    if settings.on_lost is OnLost.GROUP:
        rewards[torch.isnan(rewards).any(dim=1)] = math.nan
    known = ~torch.isnan(rewards)  # (tasks, G)
    advantages = group_advantages(rewards, settings.spread_floor)
    mask = chunk.mask & known.view(-1, 1).to(chunk.mask.device)  # (plans, tokens)
    token_advantages = [
        _token_advantages(chunk, number, rewards, advantages.values, settings.spread_floor)
        for number in range(len(chunk.tasks))
    ]  # of each task: (G, tokens or 1)
    has_plan = mask.any(dim=1).view(shape).any(dim=1).cpu()  # (tasks,)
    has_signal = torch.tensor([bool(values.any()) for values in token_advantages])  # (tasks,)
    learns = has_plan if settings.keeps_zero_variance_groups else has_plan & has_signal
    zero_variance, cut_off, longest, counted = (
        column.tolist()
        for column in (
            advantages.zero_variance,
            samples.cut_off.view(shape).sum(dim=1),
            written_lengths(samples.mask).view(shape).amax(dim=1),
            chunk.mask.sum(dim=1).view(shape).sum(dim=1),
        )
    )
    old = samples.logprobs if chunk.old_logprobs is None else chunk.old_logprobs
    found = []
    for number, (task, prompt) in enumerate(zip(chunk.tasks, chunk.prompts, strict=True)):
        rows = slice(number * group, (number + 1) * group)
        values = tuple(advantages.values[number].tolist())
        log = GroupLog(task, outcomes[number], values, zero_variance[number], cut_off[number])
        found.append(
            ScoredGroup(
                log=log,
                prompt=prompt.tokens,
                tokens=samples.tokens[rows],
                mask=mask[rows],
                old_logprobs=old[rows],
                sampler_logprobs=samples.logprobs[rows],
                reference=None if chunk.reference is None else chunk.reference[rows],
                advantages=token_advantages[number],
                longest=longest[number],
                counted=counted[number],
                learns=bool(learns[number]),
            )
        )
    return found


def _token_advantages(
    chunk: SampledChunk, number: int, rewards: Tensor, advantages: Tensor, floor: float
) -> Tensor:
    """Return the advantages of a task's tokens, (G, tokens), or of its plans, (G, 1). ``rewards``: (tasks, G)."""
    own = advantages[number].to(chunk.mask.device)  # (G,)
    if chunk.states is None:
        return own[:, None]
    rows = slice(number * len(own), (number + 1) * len(own))
    return chunk.states.of(rows).token_advantages(rewards[number], own, chunk.mask[rows], floor)


def minibatches_of(groups: Sequence[T], count: int, rng: np.random.Generator) -> list[list[T]]:
    """Divide groups at random into at most ``count`` minibatches. Their sizes differ by at most one, none is empty."""
    order = np.array_split(rng.permutation(len(groups)), count)
    return [[groups[at] for at in part] for part in order if len(part)]


def microbatches_of(minibatch: Sequence[ScoredGroup], settings: GrpoSettings) -> list[tuple[int, Microbatch]]:
    """Divide a minibatch into microbatches of ``settings.chunk`` groups. Return those with a gradient and their indices.

    Groups without a gradient count in the denominators of the loss.
    """
    size = settings.chunk
    parts = [minibatch[at : at + size] for at in range(0, len(minibatch), size)]
    totals = LossTotals(
        plans=len(minibatch) * settings.group,
        tokens=sum(each.counted for each in minibatch),
        longest=settings.max_new,
        microbatches=len(parts),
    )
    found = []
    for index, part in enumerate(parts):
        if learning := [each for each in part if each.learns]:
            own = microbatch_totals(totals, sum(each.counted for each in part), settings.loss)
            found.append((index, microbatch_of(learning, own)))
    return found


def microbatch_totals(totals: LossTotals, tokens: int, kind: LossKind) -> LossTotals:
    """Return the denominators of a microbatch with this many ``tokens``. BNPO divides by the microbatch's own tokens."""
    return replace(totals, tokens=tokens * totals.microbatches) if kind is LossKind.BNPO else totals


def microbatch_of(groups: Sequence[ScoredGroup], totals: LossTotals) -> Microbatch:
    """Join groups to one microbatch, as long as their longest plan."""
    length = max(each.longest for each in groups)

    def rows(part: Callable[[ScoredGroup], Tensor]) -> Tensor:
        return torch.cat([_with_length(part(each), length) for each in groups])

    return Microbatch(
        prompts=[each.prompt for each in groups],
        tokens=rows(lambda each: each.tokens),
        mask=rows(lambda each: each.mask),
        old_logprobs=rows(lambda each: each.old_logprobs),
        sampler_logprobs=rows(lambda each: each.sampler_logprobs),
        reference=_reference_of(groups, length),
        advantages=_joined_advantages([each.advantages for each in groups], length),
        totals=totals,
    )


def _reference_of(groups: Sequence[ScoredGroup], length: int) -> Tensor | None:
    found = [_with_length(each.reference, length) for each in groups if each.reference is not None]
    return torch.cat(found) if found else None


def _joined_advantages(groups: Sequence[Tensor], length: int) -> Tensor:
    """Join advantages of groups: (plans, 1), or (plans, tokens) if those of tokens differ."""
    by_token = any(each.shape[1] > 1 for each in groups)
    return torch.cat([_with_length(each, length) if by_token else each for each in groups])


def _with_length(rows: Tensor, length: int) -> Tensor:
    """Cut or pad rows (G, tokens) to a length. Groups of different chunks have different numbers of columns.

    The padding is 0: a mask excludes it, and no policy looks ahead of a token.
    """
    kept = rows[:, :length]
    return functional.pad(kept, (0, length - kept.shape[1]))
