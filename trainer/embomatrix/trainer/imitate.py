"""Imitation: teacher forcing on the oracle's plans, so that GRPO starts from a policy that sometimes succeeds."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from embomatrix.trainer.errors import TrainerError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from torch import Tensor

    from embomatrix.trainer.data import TrainingTask
    from embomatrix.trainer.policy.protocol import Policy, Tokens
    from embomatrix.trainer.settings import ImitationSettings
    from embomatrix.trainer.telling import Teller


@dataclass(frozen=True, slots=True)
class ImitationProgress:
    """After one step: the share of the budget that is spent, and the mean loss per plan token (nats)."""

    step: int
    share: float
    loss: float


def imitate(
    policy: Policy,
    teller: Teller,
    tasks: Sequence[TrainingTask],
    settings: ImitationSettings,
    *,
    seed: int,
    report: Callable[[ImitationProgress], None],
) -> int:
    """Train on the oracle's plans for the seconds, or the steps, of the settings; returns the number of steps.

    The learning rate warms up and falls as a cosine over the budget. Every example is told anew.
    """
    with_plan = [task for task in tasks if task.oracle]
    if settings.steps == 0 or (settings.steps is None and settings.seconds == 0):
        return 0
    if not with_plan:
        raise TrainerError("no training task carries an oracle plan to imitate: pass --imitate-seconds 0")
    rng = np.random.default_rng(np.random.SeedSequence((seed, 1)))
    optimiser = torch.optim.AdamW(
        policy.parameters(), lr=settings.learning_rate, betas=(0.9, 0.95), weight_decay=settings.weight_decay
    )
    began_s = time.monotonic()
    step = 0
    while (share := _share(settings, step, time.monotonic() - began_s)) < 1.0:
        rate = settings.learning_rate * _shape(share, step, settings.warmup_steps)
        for group in optimiser.param_groups:
            group["lr"] = rate
        chosen = rng.integers(len(with_plan), size=settings.batch)
        lessons = [teller.lesson(with_plan[int(at)], rng) for at in chosen]
        loss = _lesson_loss(policy, lessons)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimiser.step()
        step += 1
        report(ImitationProgress(step, share, float(loss.detach())))
    return step


def _share(settings: ImitationSettings, step: int, elapsed_s: float) -> float:
    return step / settings.steps if settings.steps is not None else elapsed_s / settings.seconds


def _shape(share: float, step: int, warmup: int) -> float:
    """Factor of the learning rate: a linear rise, then half a cosine down to a twentieth."""
    rise = min(1.0, (step + 1) / (warmup + 1))
    return rise * (0.05 + 0.95 * (1 + math.cos(math.pi * min(1.0, share))) / 2)


def _lesson_loss(policy: Policy, lessons: Sequence[tuple[Tokens, Tokens]]) -> Tensor:
    """Mean negative log-likelihood per plan token."""
    tokens, mask = padded_plans([plan for _, plan in lessons], policy)
    scored = policy.logprobs([prompt for prompt, _ in lessons], tokens, mask, group=1, temperature=1.0)
    return -scored.logprobs.sum() / mask.sum()


def padded_plans(plans: Sequence[Tokens], policy: Policy) -> tuple[Tensor, Tensor]:
    """Plans as rows of tokens, and the mask that is true on their own tokens; both (plans, longest)."""
    device = next(iter(policy.parameters())).device
    longest = max(len(plan) for plan in plans)
    tokens = torch.zeros(len(plans), longest, dtype=torch.long)
    mask = torch.zeros(len(plans), longest, dtype=torch.bool)
    for row, plan in enumerate(plans):
        tokens[row, : len(plan)] = torch.tensor(plan)
        mask[row, : len(plan)] = True
    return tokens.to(device), mask.to(device)
