"""Sum of the microbatches' gradients in a fixed order, independent of the order in which they finish."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor, nn


class GradientSum:
    """Sum of one step's gradients in the order of the microbatches: 0, 1, 2, …

    Floating-point sums depend on their order. A fixed order makes a step bit-identical whichever worker was faster. A
    microbatch that comes early is back-propagated at once, and its gradient is stored until its turn.
    """

    def __init__(self, parameters: Iterable[nn.Parameter]) -> None:
        self._parameters = tuple(parameters)
        self._stored: dict[int, Sequence[Tensor | None]] = {}
        self.next_index = 0
        """Index of the next microbatch to add."""
        for parameter in self._parameters:
            parameter.grad = None

    @property
    def stored(self) -> int:
        """Number of stored gradients, each as large as the policy."""
        return len(self._stored)

    def add(self, index: int, backward: Callable[[], object]) -> None:
        """Run ``backward`` and add the gradient that it leaves in the parameters."""
        if index == self.next_index:
            backward()
            self.next_index += 1
            self._add_stored()
            return
        total = [parameter.grad for parameter in self._parameters]
        for parameter in self._parameters:
            parameter.grad = None
        backward()
        self._stored[index] = [parameter.grad for parameter in self._parameters]
        for parameter, gradient in zip(self._parameters, total, strict=True):
            parameter.grad = gradient

    def put(self, index: int, gradient: Sequence[Tensor | None] | None) -> None:
        """Add a gradient by parameter from another process. None: the microbatch has no gradient."""
        self._stored[index] = gradient or [None] * len(self._parameters)
        self._add_stored()

    def scale(self, factor: float) -> None:
        """Multiply the complete sum."""
        for parameter in self._parameters:
            if parameter.grad is not None:
                parameter.grad.mul_(factor)

    def _add_stored(self) -> None:
        while (gradients := self._stored.pop(self.next_index, None)) is not None:
            for parameter, gradient in zip(self._parameters, gradients, strict=True):
                if parameter.grad is None:
                    parameter.grad = gradient
                elif gradient is not None:
                    parameter.grad.add_(gradient)
            self.next_index += 1
