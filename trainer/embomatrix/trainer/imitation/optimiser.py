"""Optimiser of imitation: AdamW, or Muon for the matrices of linear layers with AdamW for all other parameters."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn
from torch.optim import Optimizer

from embomatrix.trainer.config.settings import ImitationSettings, OptimiserKind
from embomatrix.trainer.imitation.muon import Muon

_BETAS = (0.9, 0.95)


class ImitationOptimiser:
    """One or two optimisers behind one interface, each with its own learning rate."""

    def __init__(self, module: nn.Module, settings: ImitationSettings) -> None:
        matrices = _matrices(module) if settings.optimiser is OptimiserKind.MUON else []
        matrix_ids = {id(matrix) for matrix in matrices}
        rest = [parameter for parameter in module.parameters() if id(parameter) not in matrix_ids]
        decay = settings.weight_decay
        self._parts: dict[str, tuple[Optimizer, float]] = {
            "adamw": (
                torch.optim.AdamW(rest, lr=settings.learning_rate, betas=_BETAS, weight_decay=decay),
                settings.learning_rate,
            )
        }
        if matrices:
            rate = settings.matrix_learning_rate
            self._parts["muon"] = (Muon(matrices, lr=rate, weight_decay=decay), rate)

    def step(self, factor: float) -> None:
        """Update the weights. ``factor`` scales all learning rates."""
        for optimiser, rate in self._parts.values():
            for group in optimiser.param_groups:
                group["lr"] = rate * factor
            optimiser.step()

    def state_dict(self) -> dict[str, Any]:
        return {name: optimiser.state_dict() for name, (optimiser, _) in self._parts.items()}

    def load_state_dict(self, states: Mapping[str, Any]) -> None:
        """Restore the state from ``state_dict``. Raises LookupError, TypeError or ValueError if it does not fit."""
        for name, (optimiser, _) in self._parts.items():
            optimiser.load_state_dict(states[name])


def _matrices(module: nn.Module) -> list[nn.Parameter]:
    """Trainable weights of linear layers with more than one output."""
    layers = (layer for layer in module.modules() if isinstance(layer, nn.Linear) and layer.out_features > 1)
    weights = (layer.weight for layer in layers)
    return [weight for weight in weights if isinstance(weight, nn.Parameter) and weight.requires_grad]
