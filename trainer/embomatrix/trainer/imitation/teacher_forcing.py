"""Imitation: teacher forcing on the oracle's plans, so that GRPO starts from a policy that sometimes succeeds.

Each step draws from a generator of its own, so that a run that is resumed takes the steps of one that was not interrupted.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.imitation.optimisers import ImitationOptimiser
from embomatrix.trainer.lifecycle.interrupts import Interrupts

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from torch import Tensor

    from embomatrix.trainer.config.settings import ImitationSettings
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.policy.prompts import Teller
    from embomatrix.trainer.policy.protocol import Policy, Tokens

    Lesson = tuple[Tokens, Tokens]  # prompt and plan


@dataclass
class ImitationState:
    """Where imitation stands. ``losses`` are those on tasks set aside; ``best_loss`` is the lowest, found at ``best_step``,
    ``strikes`` measurements ago."""

    step: int = 0
    seconds: float = 0.0
    best_loss: float | None = None
    best_step: int = 0
    strikes: int = 0
    losses: list[float] = field(default_factory=list)
    done: bool = False


@dataclass(frozen=True, slots=True)
class ImitationProgress:
    """After one step: the share of the budget that is spent, and the mean loss per plan token (nats).

    ``validation`` is that of the tasks set aside, where it was measured after this step.
    """

    step: int
    share: float
    loss: float
    validation: float | None = None


class Imitation:
    """Imitation of one run. Raises TrainerError where no task has a plan to imitate, and the budget is not 0.

    The learning rate warms up and falls as a cosine over the budget. Every example is told anew.
    """

    def __init__(
        self,
        policy: Policy,
        teller: Teller,
        tasks: Sequence[TrainingTask],
        settings: ImitationSettings,
        *,
        seed: int,
        state: ImitationState | None = None,
    ) -> None:
        self.state = state or ImitationState()
        self._policy = policy
        self._teller = teller
        self._settings = settings
        self._seed = seed
        self._lessons, self._aside = _parted(tasks, settings, seed)
        self._optimiser = ImitationOptimiser(policy.module, settings)
        self._best: dict[str, Tensor] = {}

    def tensors(self) -> dict[str, Any]:
        """What a checkpoint holds besides policy and ``state``."""
        return {"imitation": self._optimiser.state_dict(), "best": self._best}

    def restore(self, tensors: Mapping[str, Any]) -> None:
        """Go on from what ``tensors`` gave. Raises LookupError, TypeError or ValueError where they are not such."""
        self._optimiser.load_state_dict(tensors["imitation"])
        self._best = dict(tensors["best"])

    def run(self, report: Callable[[ImitationProgress], None]) -> None:
        """Spend the budget, or what is left of it. ``report`` hears of every step and may raise.

        An interrupt waits for the end of a step that moves the policy already.
        """
        state, earlier_s, began_s = self.state, self.state.seconds, time.monotonic()
        while not state.done:
            state.seconds = earlier_s + time.monotonic() - began_s
            share = self._share()
            if share >= 1.0 or self._gave_up():
                self._finish()
                return
            with Interrupts() as interrupts:
                loss = self._step(share, interrupts)
                state.step += 1
                measured = self._aside and state.step % self._settings.validate_every == 0
                validation = self._measure() if measured else None
                report(ImitationProgress(state.step, share, loss, validation))

    def _share(self) -> float:
        settings, state = self._settings, self.state
        if settings.steps is not None:
            return state.step / settings.steps if settings.steps else 1.0
        return state.seconds / settings.seconds if settings.seconds else 1.0

    def _gave_up(self) -> bool:
        """One lucky measurement is no reason to stop while the others go on falling: their means must have stopped as well."""
        patience, losses = self._settings.patience, self.state.losses
        if not 0 < patience <= self.state.strikes:
            return False
        before, last = losses[-2 * patience : -patience], losses[-patience:]
        return not before or fmean(last) >= fmean(before)

    def _finish(self) -> None:
        """The policy as it was when it was best, where that was measured."""
        if self._aside and self.state.step % self._settings.validate_every and self.state.step:
            self._measure()
        with Interrupts() as interrupts:
            interrupts.put_off()
            if self._best:
                self._policy.module.load_state_dict(self._best)
            self.state.done = True

    def _step(self, share: float, interrupts: Interrupts) -> float:
        settings = self._settings
        rng = np.random.default_rng(np.random.SeedSequence((self._seed, 1, self.state.step)))
        chosen = rng.integers(len(self._lessons), size=settings.batch)
        lessons = [self._teller.lesson(self._lessons[int(at)], rng) for at in chosen]
        self._optimiser.zero_grad()
        loss = self._learn(lessons)
        torch.nn.utils.clip_grad_norm_(self._policy.parameters(), 1.0)
        interrupts.put_off()
        self._optimiser.step(_shape(share, self.state.step, settings.warmup_steps))
        return loss

    def _learn(self, lessons: Sequence[Lesson]) -> float:
        """Add the gradient of the mean loss per plan token, which is returned, chunk by chunk: one at a time is in memory."""
        tokens, size = _tokens_in(lessons), self._settings.chunk or len(lessons)
        total = 0.0
        for at in range(0, len(lessons), size):
            loss = _total_loss(self._policy, lessons[at : at + size]) / tokens
            torch.autograd.backward(loss)
            total += float(loss.detach())
        return total

    def _measure(self) -> float:
        """The loss on the tasks set aside; the policy is kept where it is the lowest so far."""
        loss, state = self._loss_aside(), self.state
        state.losses.append(loss)
        if state.best_loss is None or loss < state.best_loss:
            state.best_loss, state.best_step, state.strikes = loss, state.step, 0
            self._best = {name: value.clone() for name, value in self._policy.module.state_dict().items()}
        else:
            state.strikes += 1
        return loss

    @torch.no_grad()
    def _loss_aside(self) -> float:
        """Mean loss per plan token on the tasks set aside."""
        batch = self._settings.batch
        lessons = [self._teller.plain_lesson(task) for task in self._aside]
        total = sum(
            float(_total_loss(self._policy, lessons[at : at + batch])) for at in range(0, len(lessons), batch)
        )
        return total / _tokens_in(lessons)


def _parted(
    tasks: Sequence[TrainingTask], settings: ImitationSettings, seed: int
) -> tuple[list[TrainingTask], list[TrainingTask]]:
    """Tasks to learn from, and those set aside to measure by. Raises TrainerError where there is nothing to learn from."""
    with_plan = [task for task in tasks if task.oracle]
    if settings.steps == 0 or (settings.steps is None and settings.seconds == 0):
        return with_plan, []
    if not with_plan:
        raise TrainerError("no training task carries an oracle plan to imitate: pass --imitate-seconds 0")
    if not settings.patience:
        return with_plan, []
    aside = max(1, round(settings.validation_share * len(with_plan)))
    if aside >= len(with_plan):
        raise TrainerError(
            f"imitation.patience sets {aside} of {len(with_plan)} training tasks with a plan aside, which leaves none to learn "
            "from: build a larger dataset, or leave patience out"
        )
    order = np.random.default_rng(np.random.SeedSequence((seed, 3))).permutation(len(with_plan))
    return [with_plan[at] for at in sorted(order[aside:])], [with_plan[at] for at in sorted(order[:aside])]


def _shape(share: float, step: int, warmup: int) -> float:
    """Factor of the learning rate: a linear rise, then half a cosine down to a twentieth."""
    rise = min(1.0, (step + 1) / (warmup + 1))
    return rise * (0.05 + 0.95 * (1 + math.cos(math.pi * min(1.0, share))) / 2)


def _tokens_in(lessons: Sequence[Lesson]) -> int:
    """Tokens of their plans."""
    return sum(len(plan) for _, plan in lessons)


def _total_loss(policy: Policy, lessons: Sequence[Lesson]) -> Tensor:
    """Negative log-likelihood of the plans, summed over their tokens."""
    tokens, mask = padded_plans([plan for _, plan in lessons], policy)
    scored = policy.logprobs([prompt for prompt, _ in lessons], tokens, mask, group=1, temperature=1.0)
    return -scored.logprobs.sum()


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
