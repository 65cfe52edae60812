"""Gradients of a step's parts, added in one order whatever order the parts come in."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from torch import Tensor, nn


class GradientSum:
    """Adds up the gradients of one step's parts in the order of their numbers: 0, 1, 2, …

    Sums of floating-point numbers depend on their order. Kept, a step learns the same to the bit whichever worker was
    faster. A part that comes before its turn is back-propagated at once and its gradient kept aside until its turn.
    """

    def __init__(self, parameters: Iterable[nn.Parameter]) -> None:
        self._parameters = tuple(parameters)
        self._next = 0
        self._aside: dict[int, Sequence[Tensor | None]] = {}
        for parameter in self._parameters:
            parameter.grad = None

    @property
    def aside(self) -> int:
        """How many parts wait for their turn, each with a gradient of the policy's size."""
        return len(self._aside)

    @property
    def due(self) -> int:
        """Number of the part whose turn it is."""
        return self._next

    def add(self, part: int, backward: Callable[[], object]) -> None:
        """Run ``backward`` and add what it leaves in the parameters' gradients as the share of ``part``."""
        if part == self._next:
            backward()
            self._next += 1
            self._add_what_waited()
            return
        summed = [parameter.grad for parameter in self._parameters]
        for parameter in self._parameters:
            parameter.grad = None
        backward()
        self._aside[part] = [parameter.grad for parameter in self._parameters]
        for parameter, gradient in zip(self._parameters, summed, strict=True):
            parameter.grad = gradient

    def put(self, part: int, gradient: Sequence[Tensor | None] | None) -> None:
        """Add a gradient by parameter, which was made elsewhere, as the share of ``part``; None: it has none."""
        self._aside[part] = gradient or [None] * len(self._parameters)
        self._add_what_waited()

    def scale(self, factor: float) -> None:
        """Multiply the sum, once every part is in."""
        for parameter in self._parameters:
            if parameter.grad is not None:
                parameter.grad.mul_(factor)

    def _add_what_waited(self) -> None:
        while (gradients := self._aside.pop(self._next, None)) is not None:
            for parameter, gradient in zip(self._parameters, gradients, strict=True):
                if parameter.grad is None:
                    parameter.grad = gradient
                elif gradient is not None:
                    parameter.grad.add_(gradient)
            self._next += 1
