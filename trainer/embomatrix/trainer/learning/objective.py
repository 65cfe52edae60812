"""Group relative policy optimisation as pure functions: advantages, clipped surrogate, KL term.

The paper's objective (section "Learning algorithms") for B tasks with G plans each is

    1/(BG) sum_ji min(rho_ji A_ji, clip(rho_ji, 1 - eps, 1 + eps) A_ji) - beta KL(policy || reference)

with one importance ratio rho per *plan*: ``LossKind.PAPER`` with ``RatioLevel.SEQUENCE``. A step's loss is a sum over
groups, so microbatches can be back-propagated one by one as results arrive. ``LossTotals`` carries the denominators of
the whole step, or of a minibatch.

``GrpoSettings.truncate_ratio`` is truncated importance sampling, Yao et al. 2025: plans of another policy mu, an older one or
that of a model server, are weighted with min(policy at the beginning of the step / mu, C), and the ratio compares the policy
with that at the beginning.

Sources of the other kinds: GRPO, Shao et al. 2024 (DeepSeekMath); DAPO, Yu et al. 2025; Dr. GRPO, Liu et al. 2025; GSPO,
Zheng et al. 2025; BNPO as in TRL. All kinds equal TRL's losses in value and gradient (tests/peers/test_losses_of_trl.py).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from embomatrix.trainer.config.settings import GrpoSettings, LossKind, RatioLevel


@dataclass(frozen=True, slots=True)
class LossTotals:
    """Totals of the whole step, or of a minibatch: the denominators of the loss.

    For BNPO, ``tokens`` is the microbatch's own count times ``microbatches``. ``longest`` is the maximum number of tokens
    of a plan; only Dr. GRPO uses it.
    """

    plans: int
    tokens: int
    longest: int = 1
    microbatches: int = 1


@dataclass(frozen=True, slots=True)
class Advantages:
    """``values``: (tasks, samples). ``zero_variance``: (tasks,), true for groups whose advantages are all 0."""

    values: Tensor
    zero_variance: Tensor


def group_advantages(rewards: Tensor, eps: float = 1e-4) -> Advantages:
    """Centre and scale each task's rewards within its group: A = (r - mean) / sigma.

    rewards: (tasks, samples). NaN marks a rollout lost to the infrastructure: it is excluded from mean and deviation and
    gets advantage 0. ``sigma`` is the sample standard deviation. ``eps`` is added to it, because the paper's formula
    divides by 0 for equal rewards. Groups with equal rewards or fewer than two known rewards are zero-variance groups.
    """
    known = ~torch.isnan(rewards)  # (tasks, samples)
    count = known.sum(dim=1, keepdim=True)  # (tasks, 1)
    mean = torch.nanmean(rewards, dim=1, keepdim=True).nan_to_num()  # (tasks, 1)
    centred = torch.where(known, rewards - mean, torch.zeros_like(rewards))  # (tasks, samples)
    sigma = (centred.square().sum(dim=1, keepdim=True) / (count - 1).clamp(min=1)).sqrt()  # (tasks, 1)
    low = rewards.masked_fill(~known, torch.inf).amin(dim=1)  # (tasks,)
    high = rewards.masked_fill(~known, -torch.inf).amax(dim=1)  # (tasks,)
    # Not by sigma: rounding of the mean gives equal rewards a spread.
    zero_variance = (high - low <= 1e-6) | (count[:, 0] < 2)  # (tasks,)
    values = centred / (sigma + eps)  # (tasks, samples)
    return Advantages(torch.where(zero_variance[:, None], torch.zeros_like(values), values), zero_variance)


@dataclass(frozen=True, slots=True)
class LossInputs:
    """One microbatch with plans as rows. All shapes are (plans, tokens); ``advantages`` may have (plans, 1).

    ``mask`` is true on a plan's tokens, including the end token, and false on all of a lost plan. ``reference`` and
    ``entropy`` may be None if their coefficients are 0. With coefficient 0, ``entropy`` is only logged and needs no gradient.
    ``sampler_logprobs`` is None if the policy of ``old_logprobs`` sampled the plans.
    """

    logprobs: Tensor
    old_logprobs: Tensor
    mask: Tensor
    advantages: Tensor
    reference: Tensor | None = None
    entropy: Tensor | None = None
    sampler_logprobs: Tensor | None = None


@dataclass(frozen=True, slots=True)
class LossMetrics:
    """Means over the tokens of a microbatch, for the log. ``weight`` is the number of tokens.

    ``sampler_gap`` is the mean and ``sampler_gap_max`` the maximum of the absolute difference in nats between the
    log-probabilities with which plans were sampled and those in the ratio's denominator. ``kl_to_reference`` is
    KL(policy || reference), None without a reference; ``kl_to_old`` is KL(sampling policy || policy).
    """

    clip_fraction: float
    kl_to_reference: float | None
    kl_to_old: float
    entropy: float
    sampler_gap: float
    sampler_gap_max: float
    weight: int


def surrogate_loss(
    inputs: LossInputs, settings: GrpoSettings, totals: LossTotals
) -> tuple[Tensor, LossMetrics]:
    """Return the microbatch's share of the step's loss (a scalar to minimise). All shares add up to the step's loss."""
    mask = inputs.mask.to(inputs.logprobs.dtype)  # (plans, tokens)
    level = settings.ratio_level
    importance_ratio = _ratio(inputs.logprobs, inputs.old_logprobs, mask, level)  # (plans, tokens or 1)
    advantages = inputs.advantages  # (plans, tokens or 1)
    clipped = importance_ratio.clamp(1 - settings.clip_low, 1 + settings.clip_high)
    gain = torch.minimum(importance_ratio * advantages, clipped * advantages)  # (plans, tokens or 1)
    if settings.truncate_ratio is not None and inputs.sampler_logprobs is not None:
        weight = _ratio(inputs.old_logprobs, inputs.sampler_logprobs, mask, level)  # (plans, tokens or 1)
        gain = gain * weight.clamp(max=settings.truncate_ratio)
    cost = torch.zeros_like(inputs.logprobs)  # (plans, tokens)
    if inputs.reference is not None and settings.kl_coef > 0:
        cost = cost + settings.kl_coef * kl_estimate(inputs.logprobs, inputs.reference)
    if inputs.entropy is not None and settings.entropy_coef > 0:
        cost = cost - settings.entropy_coef * inputs.entropy
    loss = _average(cost, mask, settings.loss, totals) - _average_gain(gain, mask, settings, totals)
    return loss, _metrics(inputs, mask, importance_ratio, settings)


def _ratio(logprobs: Tensor, old_logprobs: Tensor, mask: Tensor, level: RatioLevel) -> Tensor:
    """Return the ratio of probabilities: (plans, tokens) for ``TOKEN``, (plans, 1) for the levels of a plan."""
    log_ratio = (logprobs - old_logprobs) * mask  # (plans, tokens)
    if level is not RatioLevel.TOKEN:
        log_ratio = log_ratio.sum(dim=1, keepdim=True)  # (plans, 1)
    if level is RatioLevel.MEAN:
        log_ratio = log_ratio / mask.sum(dim=1, keepdim=True).clamp(min=1)
    return log_ratio.exp()


def kl_estimate(logprobs: Tensor, reference: Tensor) -> Tensor:
    """Estimate KL(policy || reference) per token that the policy sampled: Schulman's k3, unbiased and never negative."""
    gap = reference - logprobs
    return gap.exp() - gap - 1


def _average_gain(gain: Tensor, mask: Tensor, settings: GrpoSettings, totals: LossTotals) -> Tensor:
    """A ratio per plan gives one term per plan in the paper's loss; in all others it applies to each token."""
    if settings.loss is LossKind.PAPER and settings.ratio_level is not RatioLevel.TOKEN:
        if gain.shape[1] > 1:  # advantages of tokens: the plan's is their mean
            gain = (gain * mask).sum(dim=1, keepdim=True) / mask.sum(dim=1, keepdim=True).clamp(min=1)
        present = mask.amax(dim=1)  # (plans,): 0 for a lost rollout
        return (gain[:, 0] * present).sum() / max(totals.plans, 1)
    return _average(gain.expand_as(mask), mask, settings.loss, totals)


def _average(values: Tensor, mask: Tensor, kind: LossKind, totals: LossTotals) -> Tensor:
    per_plan = (values * mask).sum(dim=1)  # (plans,)
    if kind in (LossKind.GRPO, LossKind.GSPO):
        per_plan = per_plan / mask.sum(dim=1).clamp(min=1)
    return per_plan.sum() / loss_divisor(kind, totals)


def loss_divisor(kind: LossKind, totals: LossTotals) -> int:
    """Return the denominator of the loss."""
    if kind in (LossKind.BNPO, LossKind.DAPO):
        return max(totals.tokens, 1)
    return max(totals.plans, 1) * (totals.longest if kind is LossKind.DR_GRPO else 1)


@torch.no_grad()
def _metrics(
    inputs: LossInputs, mask: Tensor, importance_ratio: Tensor, settings: GrpoSettings
) -> LossMetrics:
    advantages = inputs.advantages  # (plans, tokens or 1)
    low = (importance_ratio < 1 - settings.clip_low) & (advantages < 0)
    high = (importance_ratio > 1 + settings.clip_high) & (advantages > 0)
    tokens = mask.sum().clamp(min=1)

    def mean(values: Tensor) -> float:
        return float((values * mask).sum() / tokens)

    reference, entropy = inputs.reference, inputs.entropy
    sampler = inputs.old_logprobs if inputs.sampler_logprobs is None else inputs.sampler_logprobs
    gap = (inputs.old_logprobs - sampler).abs() * mask  # (plans, tokens)
    return LossMetrics(
        clip_fraction=mean((low | high).to(mask.dtype).expand_as(mask)),
        kl_to_reference=None if reference is None else mean(kl_estimate(inputs.logprobs, reference)),
        kl_to_old=mean(kl_estimate(sampler, inputs.logprobs)),
        entropy=0.0 if entropy is None else mean(entropy),
        sampler_gap=mean(gap),
        sampler_gap_max=float(gap.max()),
        weight=int(mask.sum()),
    )
