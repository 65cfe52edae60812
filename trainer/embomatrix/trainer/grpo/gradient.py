"""Gradient of a minibatch, summed over microbatches that several processes back-propagate."""

from collections.abc import Sequence

from torch import Tensor

from embomatrix.trainer.grpo.data_parallel import DataParallelWorkers, RemoteLearner
from embomatrix.trainer.grpo.learner import Learner, Microbatch
from embomatrix.trainer.grpo.objective import LossMetrics
from embomatrix.trainer.policy.protocol import Policy

Gradient = Sequence[Tensor | None]
"""Gradient by parameter. None: the parameter has none."""


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
        if not self._workers.has_remotes:
            return learner.learn(microbatch), None
        total = [parameter.grad for parameter in self._policy.parameters()]
        self.clear()
        metrics = learner.learn(microbatch)
        gradient = [parameter.grad for parameter in self._policy.parameters()]
        for parameter, part in zip(self._policy.parameters(), total, strict=True):
            parameter.grad = part
        return metrics, gradient

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
