"""Gradient of an update, summed over microbatches that several processes back-propagate."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import TypeVar

from torch import Tensor

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers, RemoteLearner
from embomatrix.trainer.learning.learner import Learner, Microbatch
from embomatrix.trainer.learning.likelihood import plan_tokens
from embomatrix.trainer.learning.objective import LossMetrics
from embomatrix.trainer.policy.protocol import ImitationExample, Policy

MAX_BAD_GRADIENTS = 5
"""Consecutive updates with a non-finite gradient before training ends: it has diverged."""
T = TypeVar("T")
Gradient = Sequence[Tensor | None]
"""Gradient by parameter. None: the parameter has none."""


class FiniteGradients:
    """Keeps gradients that are not finite from the weights. ``remedy`` ends the sentence of the error."""

    def __init__(self, remedy: str) -> None:
        self._remedy = remedy
        self._bad = 0

    def may_apply(self, norm: float, step: int) -> bool:
        """Return whether a gradient of this norm may change the weights. Raises TrainerError after too many that may not."""
        if math.isfinite(norm):
            self._bad = 0
            return True
        self._bad += 1
        if self._bad >= MAX_BAD_GRADIENTS:
            raise TrainerError(
                f"the gradient norm in step {step} is {norm}, not finite for the {MAX_BAD_GRADIENTS}th update in a row; these "
                f"updates left the policy unchanged: {self._remedy}"
            )
        return False


class GradientSum:
    """Sum of gradients in the parameters of the policy.

    Floating-point sums depend on their order, so callers add gradients in the order of the microbatches.
    """

    def __init__(self, policy: Policy, workers: DataParallelWorkers) -> None:
        self._policy = policy
        self._workers = workers

    def clear(self) -> None:
        for parameter in self._policy.parameters():
            parameter.grad = None

    def learn(
        self, microbatch: Microbatch, learner: Learner | RemoteLearner
    ) -> tuple[LossMetrics, Gradient | None]:
        """Return the metrics of a microbatch and its gradient for ``add``. None: the sum contains it already.

        With several processes the gradient is separate, because gradients of other processes may come before it.
        """
        if isinstance(learner, RemoteLearner):
            return learner.learn(microbatch)
        return self._separately(functools.partial(learner.learn, microbatch))

    def imitate(self, batch: Sequence[ImitationExample], size: int) -> float:
        """Replace the sum by the gradient of the mean loss per plan token of a batch, and return this loss.

        The batch is back-propagated in microbatches of ``size`` examples.
        """
        self.clear()
        tokens = plan_tokens(batch)
        parts = [batch[at : at + size] for at in range(0, len(batch), size)]
        jobs = [(index, functools.partial(self._imitate, part, tokens)) for index, part in enumerate(parts)]
        total = 0.0
        for loss, gradient in self._workers.map(jobs):
            self.add(gradient)
            total += loss
        return total

    def _imitate(
        self, examples: Sequence[ImitationExample], tokens: int, learner: Learner | RemoteLearner
    ) -> tuple[float, Gradient | None]:
        if isinstance(learner, RemoteLearner):
            return learner.imitate(examples, tokens)
        return self._separately(functools.partial(learner.imitate, examples, tokens))

    def _separately(self, job: Callable[[], T]) -> tuple[T, Gradient | None]:
        """Run a job of this process that adds to the parameters' gradients. Return its result, and its own gradient.

        With one process that gradient is None: it stays in the parameters.
        """
        if not self._workers.has_remotes:
            return job(), None
        total = [parameter.grad for parameter in self._policy.parameters()]
        self.clear()
        result = job()
        gradient = [parameter.grad for parameter in self._policy.parameters()]
        for parameter, part in zip(self._policy.parameters(), total, strict=True):
            parameter.grad = part
        return result, gradient

    def add(self, gradient: Gradient | None) -> None:
        """Add a gradient that ``learn`` returned."""
        if gradient is None:
            return
        for parameter, part in zip(self._policy.parameters(), gradient, strict=True):
            if parameter.grad is None:
                parameter.grad = part
            elif part is not None:
                parameter.grad.add_(part)

    def scale(self, factor: float) -> None:
        for parameter in self._policy.parameters():
            if parameter.grad is not None:
                parameter.grad.mul_(factor)
