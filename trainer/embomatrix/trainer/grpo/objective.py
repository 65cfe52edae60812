"""Group relative policy optimisation as pure functions: advantages, the clipped surrogate, the KL term.

The paper's objective (section "Learning algorithms") is, for B tasks with G plans each,

    1/(BG) sum_ji min(rho_ji A_ji, clip(rho_ji, 1 - eps, 1 + eps) A_ji) - beta KL(policy || reference)

with one ratio rho per *plan*: ``LossKind.PAPER`` with ``RatioLevel.SEQUENCE``. Sums over a step are linear in its groups,
so a step may be back-propagated group by group, as results arrive: ``Scale`` carries the totals of the whole step.

Sources of the other kinds: GRPO, Shao et al. 2024 (DeepSeekMath); DAPO, Yu et al. 2025; Dr. GRPO, Liu et al. 2025; GSPO,
Zheng et al. 2025; BNPO as TRL names it. All of them equal TRL's in value and gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


class LossKind(StrEnum):
    """What a step's token terms are averaged over."""

    PAPER = "paper"  # summed over a plan's tokens, averaged over plans: as the paper prints it
    GRPO = "grpo"  # averaged over a plan's tokens, then over plans: DeepSeekMath
    BNPO = "bnpo"  # averaged over the tokens of each part of the step, then over parts
    DAPO = "dapo"  # averaged over all tokens of the step: long plans weigh by their length
    DR_GRPO = "dr_grpo"  # summed over tokens, divided by plans times the longest plan allowed: length weighs nothing
    GSPO = "gspo"  # as GRPO, with the geometric mean of a plan's token ratios in place of each


class RatioLevel(StrEnum):
    """Whether the ratio of new to old probability is taken per token or per plan."""

    TOKEN = "token"
    SEQUENCE = "sequence"  # the product over a plan's tokens, as the paper prints it
    MEAN = "mean"  # its root of the plan's length: GSPO


@dataclass(frozen=True, slots=True)
class Objective:
    """Constants of the surrogate. ``clip_high`` above ``clip_low`` leaves room for rare tokens to grow (DAPO)."""

    kind: LossKind = LossKind.DAPO
    ratio: RatioLevel = RatioLevel.TOKEN
    clip_low: float = 0.2
    clip_high: float = 0.28
    kl_coef: float = 0.0
    entropy_coef: float = 0.0

    @property
    def level(self) -> RatioLevel:
        """The ratio's level: GSPO brings its own."""
        return RatioLevel.MEAN if self.kind is LossKind.GSPO else self.ratio


@dataclass(frozen=True, slots=True)
class Scale:
    """Totals over the whole step, by which every part of it is divided.

    ``plans`` counts the plans and ``tokens`` theirs; for BNPO ``tokens`` are those of this part times ``parts``, the number of
    parts. ``longest`` is the number of tokens that a plan may have at most; Dr. GRPO alone divides by it.
    """

    plans: int
    tokens: int
    longest: int = 1
    parts: int = 1


@dataclass(frozen=True, slots=True)
class Advantages:
    """``values``: (tasks, samples). ``dead``: (tasks,), groups that carry no signal: equal rewards, or fewer than two."""

    values: Tensor
    dead: Tensor


def group_advantages(rewards: Tensor, eps: float = 1e-4) -> Advantages:
    """Centre and scale each task's rewards by its own group: the paper's A = (r - mean) / sigma.

    rewards: (tasks, samples). NaN marks a rollout that the infrastructure lost: it moves neither mean nor spread and
    gets advantage 0. ``sigma`` is the sample deviation; ``eps`` keeps a group of equal rewards at 0, where the paper's
    formula divides by 0.
    """
    known = ~torch.isnan(rewards)  # (tasks, samples)
    count = known.sum(dim=1, keepdim=True)  # (tasks, 1)
    mean = torch.nanmean(rewards, dim=1, keepdim=True).nan_to_num()  # (tasks, 1)
    centred = torch.where(known, rewards - mean, torch.zeros_like(rewards))  # (tasks, samples)
    sigma = (centred.square().sum(dim=1, keepdim=True) / (count - 1).clamp(min=1)).sqrt()  # (tasks, 1)
    dead = (sigma[:, 0] < 1e-6) | (count[:, 0] < 2)
    values = centred / (sigma + eps)
    return Advantages(torch.where(dead[:, None], torch.zeros_like(values), values), dead)


@dataclass(frozen=True, slots=True)
class Terms:
    """One part of a step, plans as rows. All but ``advantages`` (plans,) have shape (plans, tokens).

    ``mask`` is true on a plan's own tokens up to and with the end token; rows that were lost are false throughout.
    ``reference`` and ``entropy`` may be absent where their coefficients are 0.
    """

    logprobs: Tensor
    old_logprobs: Tensor
    mask: Tensor
    advantages: Tensor
    reference: Tensor | None = None
    entropy: Tensor | None = None


@dataclass(frozen=True, slots=True)
class LossMetrics:
    """Token means over the part, for the log. ``weight`` is its number of tokens."""

    clip_fraction: float
    kl_to_reference: float
    kl_to_old: float
    entropy: float
    weight: int


def surrogate_loss(terms: Terms, objective: Objective, scale: Scale) -> tuple[Tensor, LossMetrics]:
    """This part's share of the step's loss, to be minimised: shares of all parts add up to the whole."""
    mask = terms.mask.to(terms.logprobs.dtype)  # (plans, tokens)
    log_ratio = (terms.logprobs - terms.old_logprobs) * mask
    if objective.level is not RatioLevel.TOKEN:
        log_ratio = log_ratio.sum(dim=1, keepdim=True)  # (plans, 1)
    if objective.level is RatioLevel.MEAN:
        log_ratio = log_ratio / mask.sum(dim=1, keepdim=True).clamp(min=1)
    ratio = log_ratio.exp()
    advantages = terms.advantages[:, None]  # (plans, 1)
    clipped = ratio.clamp(1 - objective.clip_low, 1 + objective.clip_high)
    gain = torch.minimum(ratio * advantages, clipped * advantages)  # (plans, tokens or 1)
    cost = torch.zeros_like(terms.logprobs)  # (plans, tokens)
    if terms.reference is not None and objective.kl_coef > 0:
        cost = cost + objective.kl_coef * kl_estimate(terms.logprobs, terms.reference)
    if terms.entropy is not None and objective.entropy_coef > 0:
        cost = cost - objective.entropy_coef * terms.entropy
    loss = _averaged(cost, mask, objective.kind, scale) - _averaged_gain(gain, mask, objective, scale)
    return loss, _metrics(terms, mask, ratio, objective)


def kl_estimate(logprobs: Tensor, reference: Tensor) -> Tensor:
    """Unbiased, never negative estimate of KL(policy || reference) per sampled token: Schulman's k3."""
    gap = reference - logprobs
    return gap.exp() - gap - 1


def _averaged_gain(gain: Tensor, mask: Tensor, objective: Objective, scale: Scale) -> Tensor:
    """A ratio per plan is one term per plan in the paper's objective, else it stands for every token."""
    if objective.kind is LossKind.PAPER and objective.level is not RatioLevel.TOKEN:
        present = mask.amax(dim=1)  # (plans,): 0 where the rollout was lost
        return (gain[:, 0] * present).sum() / max(scale.plans, 1)
    return _averaged(gain.expand_as(mask), mask, objective.kind, scale)


def _averaged(values: Tensor, mask: Tensor, kind: LossKind, scale: Scale) -> Tensor:
    summed = (values * mask).sum(dim=1)  # (plans,)
    if kind in (LossKind.GRPO, LossKind.GSPO):
        summed = summed / mask.sum(dim=1).clamp(min=1)
    return summed.sum() / divisor(kind, scale)


def divisor(kind: LossKind, scale: Scale) -> int:
    """What the sum of a step's terms is divided by."""
    if kind in (LossKind.BNPO, LossKind.DAPO):
        return max(scale.tokens, 1)
    return max(scale.plans, 1) * (scale.longest if kind is LossKind.DR_GRPO else 1)


@torch.no_grad()
def _metrics(terms: Terms, mask: Tensor, ratio: Tensor, objective: Objective) -> LossMetrics:
    advantages = terms.advantages[:, None]
    low = (ratio < 1 - objective.clip_low) & (advantages < 0)
    high = (ratio > 1 + objective.clip_high) & (advantages > 0)
    tokens = mask.sum().clamp(min=1)

    def mean(values: Tensor) -> float:
        return float((values * mask).sum() / tokens)

    return LossMetrics(
        clip_fraction=mean((low | high).to(mask.dtype).expand_as(mask)),
        kl_to_reference=0.0
        if terms.reference is None
        else mean(kl_estimate(terms.logprobs, terms.reference)),
        kl_to_old=mean(kl_estimate(terms.logprobs, terms.old_logprobs)),
        entropy=0.0 if terms.entropy is None else mean(terms.entropy),
        weight=int(mask.sum()),
    )
