"""Linear layers that multiply in a shorter data type than their weights, such as bfloat16 on a CPU with AVX-512 BF16.

Such products take a quarter of the time. Weights, gradients and optimiser state stay in float32, unlike in a model that
is stored in 16 bits.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from embomatrix.trainer.config.settings import ComputeDtype


class MixedLinear(nn.Linear):
    """Linear layer ``y = W x + b`` that multiplies in ``compute_dtype``. The output has this dtype, gradients the weight's."""

    def __init__(
        self, in_features: int, out_features: int, compute_dtype: torch.dtype, *, bias: bool = False
    ) -> None:
        super().__init__(in_features, out_features, bias=bias)
        self.compute_dtype = compute_dtype
        self.cast_weight: Tensor | None = None
        """Cached weight in ``compute_dtype``, valid inside ``frozen_weights``."""

    def forward(self, x: Tensor) -> Tensor:
        """(…, in_features) to (…, out_features)."""
        weight = self.weight.to(self.compute_dtype) if self.cast_weight is None else self.cast_weight
        bias = None if self.bias is None else self.bias.to(self.compute_dtype)
        return functional.linear(x.to(self.compute_dtype), weight, bias)


class CastingLinear(MixedLinear):
    """Mixed linear layer whose output has the dtype of its input, for models without support for ``compute_dtype``."""

    def forward(self, x: Tensor) -> Tensor:
        """(…, in_features) to (…, out_features)."""
        return super().forward(x).to(x.dtype)

    @classmethod
    def replacing(cls, layer: nn.Linear, compute_dtype: torch.dtype) -> CastingLinear:
        """Return a layer that shares the parameters of ``layer``."""
        with torch.device("meta"):
            made = cls(layer.in_features, layer.out_features, compute_dtype, bias=layer.bias is not None)
        made.weight, made.bias = layer.weight, layer.bias
        return made


def use_compute_dtype(model: nn.Module, compute_dtype: torch.dtype, head: nn.Module | None) -> None:
    """Replace the model's linear layers by casting ones. ``head`` stays in float32: token scores need all digits."""
    for parent in list(model.modules()):
        for name, layer in list(parent.named_children()):
            if type(layer) is nn.Linear and layer is not head:
                setattr(parent, name, CastingLinear.replacing(layer, compute_dtype))


@contextlib.contextmanager
def frozen_weights(model: nn.Module) -> Iterator[None]:
    """Cast each weight once for many forward passes. The weights must not change inside the block."""
    layers = [layer for layer in model.modules() if isinstance(layer, MixedLinear)]
    try:
        for layer in layers:
            layer.cast_weight = layer.weight.detach().to(layer.compute_dtype)
        yield
    finally:
        for layer in layers:
            layer.cast_weight = None


def torch_dtype(compute_dtype: ComputeDtype, device: str) -> torch.dtype:
    """Return the torch dtype. AUTO is bfloat16 on a CPU with AVX-512 BF16 instructions, else float32."""
    if compute_dtype is ComputeDtype.AUTO:
        query: Callable[[], Mapping[str, Any]] = getattr(
            torch.cpu, "get_capabilities", dict
        )  # newer torch only
        supported = device == "cpu" and query().get("avx512_bf16", False)
        compute_dtype = ComputeDtype.BFLOAT16 if supported else ComputeDtype.FLOAT32
    return torch.bfloat16 if compute_dtype is ComputeDtype.BFLOAT16 else torch.float32
