"""Matrix products in fewer bits than the weights have: a processor with instructions for it takes a quarter of the time.

Weights, their gradients and their optimiser stay whole, unlike in a model that is kept in 16 bits.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.nn import functional

from embomatrix.trainer.config.settings import Products

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from torch import Tensor


class Product(nn.Linear):
    """``y = W x + b``, multiplied in a type of its own. The result is of that type; gradients are of the weight's."""

    def __init__(self, inside: int, outside: int, products: torch.dtype, *, bias: bool = False) -> None:
        super().__init__(inside, outside, bias=bias)
        self.products = products
        self.converted: Tensor | None = None
        """The weight as it is multiplied, while it is known not to change."""

    def forward(self, x: Tensor) -> Tensor:
        """(…, inside) to (…, outside)."""
        weight = self.weight.to(self.products) if self.converted is None else self.converted
        bias = None if self.bias is None else self.bias.to(self.products)
        return functional.linear(x.to(self.products), weight, bias)


class ProductBetween(Product):
    """A product between layers that know nothing of its type: the result is of its input's."""

    def forward(self, x: Tensor) -> Tensor:
        """(…, inside) to (…, outside)."""
        return super().forward(x).to(x.dtype)

    @classmethod
    def of(cls, layer: nn.Linear, products: torch.dtype) -> ProductBetween:
        """In place of ``layer``, with its parameters."""
        with torch.device("meta"):
            made = cls(layer.in_features, layer.out_features, products, bias=layer.bias is not None)
        made.weight, made.bias = layer.weight, layer.bias
        return made


def multiply_in(model: nn.Module, products: torch.dtype, head: nn.Module | None) -> None:
    """Let the linear layers of ``model`` multiply in ``products``.

    Not so ``head``, whose results are the scores of words: they want all their digits.
    """
    for parent in list(model.modules()):
        for name, layer in list(parent.named_children()):
            if type(layer) is nn.Linear and layer is not head:
                setattr(parent, name, ProductBetween.of(layer, products))


@contextlib.contextmanager
def unchanged(model: nn.Module) -> Iterator[None]:
    """For many words in a row: no weight changes or learns meanwhile, so that each is converted once."""
    layers = [layer for layer in model.modules() if isinstance(layer, Product)]
    try:
        for layer in layers:
            layer.converted = layer.weight.detach().to(layer.products)
        yield
    finally:
        for layer in layers:
            layer.converted = None


def type_of(products: Products, device: str) -> torch.dtype:
    """What ``products`` means on a device: half the bits where its processor multiplies them in one instruction."""
    if products is Products.AUTO:
        tell: Callable[[], Mapping[str, Any]] = getattr(torch.cpu, "get_capabilities", dict)
        told = tell()  # nothing, in torches before it could be asked
        able = device == "cpu" and told.get("avx512_bf16", False)
        products = Products.BFLOAT16 if able else Products.FLOAT32
    return torch.bfloat16 if products is Products.BFLOAT16 else torch.float32
