"""Gradient checkpointing, Chen et al. 2016: a layer keeps its input alone, and computes the rest again on the way back."""

from __future__ import annotations

import contextlib
import functools
from typing import TYPE_CHECKING

from torch import nn
from torch.utils.checkpoint import checkpoint

from embomatrix.trainer.config.errors import TrainerError

if TYPE_CHECKING:
    from collections.abc import Iterator


def layers_of(model: nn.Module) -> nn.ModuleList:
    """The stack of a model's layers: its longest list of modules. Raises TrainerError where it has none."""
    lists = [module for module in model.modules() if isinstance(module, nn.ModuleList)]
    if not lists:
        raise TrainerError("gradient_checkpointing: the model has no list of layers: leave it out")
    return max(lists, key=len)


@contextlib.contextmanager
def recomputing(model: nn.Module) -> Iterator[None]:
    """What is computed meanwhile keeps no activations of the inside of layers. It must use no cache: layers run twice."""
    layers = layers_of(model)
    try:
        for layer in layers:
            # The generators' state need not be kept: a policy drops nothing out.
            layer.forward = functools.partial(
                checkpoint, layer.forward, use_reentrant=False, preserve_rng_state=False
            )
        yield
    finally:
        for layer in layers:
            layer.__dict__.pop("forward", None)
