"""Imitation: teacher forcing on the oracle plans, so that GRPO starts from a policy that sometimes succeeds.

Each step has its own random generator, so a resumed run takes the same steps as an uninterrupted one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import ImitationSettings
from embomatrix.trainer.imitation.optimiser import ImitationOptimiser
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
from embomatrix.trainer.learning.gradient import FiniteGradients, GradientSum
from embomatrix.trainer.learning.likelihood import negative_log_likelihood, plan_tokens
from embomatrix.trainer.lifecycle.checkpoint import ImitationState
from embomatrix.trainer.lifecycle.interrupts import DeferredInterrupts
from embomatrix.trainer.policy.prompts import Examples
from embomatrix.trainer.policy.protocol import Policy

if TYPE_CHECKING:
    from embomatrix.trainer.data.tasks import TrainingTask


@dataclass(frozen=True, slots=True)
class ImitationProgress:
    """Progress after one step: the used share of the budget, and the mean loss per plan token (nats).

    ``validation`` is the validation loss, if it was evaluated after this step.
    """

    step: int
    share: float
    loss: float
    validation: float | None = None


class Imitation:
    """Imitation phase of one run. Raises TrainerError if no task has an oracle plan, unless the budget is 0.

    The learning rate warms up linearly and then follows a cosine over the budget. Prompts are varied anew in every step.
    ``policy`` is the policy of the data-parallel workers.
    """

    def __init__(
        self,
        policy: Policy,
        workers: DataParallelWorkers,
        source: Examples,
        tasks: Sequence[TrainingTask],
        settings: ImitationSettings,
        *,
        seed: int,
        state: ImitationState | None = None,
    ) -> None:
        self.state = state or ImitationState()
        self._policy = policy
        self._source = source
        self._settings = settings
        self._seed = seed
        # Other tasks are held back for validation.
        self.training, self._validation = _split_tasks(tasks, settings, seed)
        self._gradient = GradientSum(policy, workers)
        self._optimiser = ImitationOptimiser(policy.module, settings)
        self._best: dict[str, Tensor] = {}
        self._finite = FiniteGradients(
            "lower imitation.learning_rate, or imitation.matrix_learning_rate of the word-level policy, and start a new run"
        )

    def tensors(self) -> dict[str, Any]:
        """State for a checkpoint, besides the policy and ``state``."""
        return {"imitation": self._optimiser.state_dict(), "best": self._best}

    def restore(self, tensors: Mapping[str, Any]) -> None:
        """Restore the state from ``tensors``. Raises LookupError, TypeError or ValueError if it does not fit."""
        self._optimiser.load_state_dict(tensors["imitation"])
        self._best = dict(tensors["best"])

    def run(
        self, report: Callable[[ImitationProgress], None], prepare: Callable[[float], None] = lambda _: None
    ) -> None:
        """Use up the rest of the budget. ``report`` is called after every step and may raise.

        ``prepare`` is called before every step with the used share of the budget, and may raise and add examples; its time is
        not part of the budget. Ctrl-C is deferred while the weights change.
        """
        state, earlier_s, began_s = self.state, self.state.seconds, time.monotonic()
        while not state.done:
            state.seconds = earlier_s + time.monotonic() - began_s
            share = self._share()
            if share >= 1.0 or self._should_stop():
                self._finish()
                return
            paused_s = time.monotonic()
            prepare(share)
            began_s += time.monotonic() - paused_s
            with DeferredInterrupts() as interrupts:
                loss = self._step(share, interrupts)
                state.step += 1
                measured = self._validation and state.step % self._settings.validate_every == 0
                validation = self._validate() if measured else None
                report(ImitationProgress(state.step, share, loss, validation))

    def _share(self) -> float:
        settings, state = self._settings, self.state
        if settings.steps is not None:
            return state.step / settings.steps if settings.steps else 1.0
        return state.seconds / settings.seconds if settings.seconds else 1.0

    def _should_stop(self) -> bool:
        """Early stopping.

        One low outlier must not end imitation while the loss still falls: the mean must have stopped falling too.
        """
        patience, losses = self._settings.patience, self.state.losses
        if not 0 < patience <= self.state.stale_evaluations:
            return False
        before, last = losses[-2 * patience : -patience], losses[-patience:]
        return not before or fmean(last) >= fmean(before)

    def _finish(self) -> None:
        """Restore the weights with the lowest validation loss."""
        if self._validation and self.state.step % self._settings.validate_every and self.state.step:
            self._validate()
        with DeferredInterrupts() as interrupts:
            interrupts.defer()
            if self._best:
                self._policy.module.load_state_dict(self._best)
            self.state.done = True

    def _step(self, share: float, interrupts: DeferredInterrupts) -> float:
        settings = self._settings
        rng = np.random.default_rng(np.random.SeedSequence((self._seed, 1, self.state.step)))
        chosen = rng.integers(len(self.training), size=settings.batch)
        examples = [self._source.example(self.training[int(at)], rng) for at in chosen]
        loss = self._gradient.imitate(examples, settings.chunk or len(examples))
        norm = float(torch.nn.utils.clip_grad_norm_(self._policy.parameters(), 1.0))
        interrupts.defer()
        if self._finite.may_apply(norm, self.state.step + 1):
            self._optimiser.step(_rate_factor(share, self.state.step, settings.warmup_steps))
        return loss

    def _validate(self) -> float:
        """Evaluate the validation loss, and keep the weights if it is the lowest so far."""
        loss, state = self._validation_loss(), self.state
        state.losses.append(loss)
        if state.best_loss is None or loss < state.best_loss:
            state.best_loss, state.best_step, state.stale_evaluations = loss, state.step, 0
            self._best = {name: value.clone() for name, value in self._policy.module.state_dict().items()}
        else:
            state.stale_evaluations += 1
        return loss

    @torch.no_grad()
    def _validation_loss(self) -> float:
        """Mean loss per plan token on the validation tasks."""
        batch = self._settings.batch
        examples = [self._source.plain_example(task) for task in self._validation]
        total = sum(
            float(negative_log_likelihood(self._policy, examples[at : at + batch]))
            for at in range(0, len(examples), batch)
        )
        return total / plan_tokens(examples)


def _split_tasks(
    tasks: Sequence[TrainingTask], settings: ImitationSettings, seed: int
) -> tuple[list[TrainingTask], list[TrainingTask]]:
    """Return training and validation tasks. Raises TrainerError if no training task is left."""
    with_plan = [task for task in tasks if task.oracle]
    if settings.steps == 0 or (settings.steps is None and settings.seconds == 0):
        return with_plan, []
    if not with_plan:
        raise TrainerError("no training task has an oracle plan to imitate: pass --imitate-seconds 0")
    if not settings.patience:
        return with_plan, []
    held_back = max(1, round(settings.validation_share * len(with_plan)))
    if held_back >= len(with_plan):
        raise TrainerError(
            f"imitation.patience holds back {held_back} of {len(with_plan)} training tasks with an oracle plan for "
            "validation, which leaves none to train on: build a larger dataset, or leave patience out"
        )
    order = np.random.default_rng(np.random.SeedSequence((seed, 3))).permutation(len(with_plan))
    return [with_plan[at] for at in sorted(order[held_back:])], [
        with_plan[at] for at in sorted(order[:held_back])
    ]


def _rate_factor(share: float, step: int, warmup: int) -> float:
    """Factor of the learning rate: linear warm-up, then half a cosine down to a twentieth."""
    rise = min(1.0, (step + 1) / (warmup + 1))
    return rise * (0.05 + 0.95 * (1 + math.cos(math.pi * min(1.0, share))) / 2)
