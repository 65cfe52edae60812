"""Low-rank adapters, Hu et al. 2021 (LoRA): a model's linear layers stay as they are, and a small product beside each learns.

The optimiser's state and a step's gradients are of the adapters' size; the reference shares the frozen weights.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

import torch
from torch import nn

from embomatrix.trainer.config.errors import DAMAGE, TrainerError, reason_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from torch import Tensor

_WEIGHTS: Final = "lora.pt"
_DESCRIPTION: Final = "lora.json"


@dataclass(frozen=True, slots=True)
class LoraShape:
    """``rank`` of the product; it is scaled by ``alpha / rank``. ``targets``: last parts of layers' names; none: all."""

    rank: int
    alpha: float
    targets: tuple[str, ...] = ()


class LoraLinear(nn.Module):
    """``y = W x + b + (alpha / rank) · B A x`` with W and b frozen; B starts at 0, so that the layer starts as it was."""

    def __init__(self, inner: nn.Linear, shape: LoraShape, generator: torch.Generator) -> None:
        super().__init__()
        self.inner = inner.requires_grad_(False)
        self.scale = shape.alpha / shape.rank
        bound = 1.0 / math.sqrt(inner.in_features)
        drawn = torch.rand(shape.rank, inner.in_features, generator=generator) * 2 * bound - bound
        device = inner.weight.device
        self.down = nn.Parameter(drawn.to(device))  # A: (rank, in)
        self.up = nn.Parameter(torch.zeros(inner.out_features, shape.rank, device=device))  # B: (out, rank)

    def forward(self, x: Tensor) -> Tensor:
        """(…, in) to (…, out). The product is computed in float32, whatever the layer's own type."""
        beside = x.to(self.down.dtype) @ self.down.T @ self.up.T  # (…, out)
        return self.inner(x) + (self.scale * beside).to(x.dtype)  # type: ignore[no-any-return]

    def merged(self) -> nn.Linear:
        """One plain layer that does the same."""
        inner = self.inner
        with torch.device("meta"):
            plain = nn.Linear(inner.in_features, inner.out_features, bias=inner.bias is not None)
        weight = inner.weight.detach().to(self.down.dtype) + self.scale * (self.up @ self.down).detach()
        plain.weight = nn.Parameter(weight.to(inner.weight.dtype), requires_grad=False)
        plain.bias = inner.bias
        return plain


def adapt(model: nn.Module, shape: LoraShape, *, seed: int, head: nn.Module | None) -> None:
    """Freeze ``model`` and put adapters on its linear layers, ``head`` left out. Raises TrainerError where none is found."""
    model.requires_grad_(False)
    generator = torch.Generator().manual_seed(seed)
    found = [
        name
        for name, module in model.named_modules()
        if isinstance(module, nn.Linear)
        and module is not head
        and (not shape.targets or name.rpartition(".")[2] in shape.targets)
    ]
    if not found:
        raise TrainerError(
            f"lora.targets: the model has no linear layer called {' or '.join(shape.targets) or 'anything'}: expected last "
            "parts of its layers' names, such as q_proj; an empty list takes all"
        )
    for name in found:
        layer = model.get_submodule(name)
        assert isinstance(layer, nn.Linear)
        _put(model, name, LoraLinear(layer, shape, generator))


def adapters(model: nn.Module) -> dict[str, LoraLinear]:
    """Adapted layers by name."""
    return {name: module for name, module in model.named_modules() if isinstance(module, LoraLinear)}


@contextlib.contextmanager
def merged(model: nn.Module) -> Iterator[None]:
    """For a while the model has plain layers with the adapters added in: what others can load."""
    found = adapters(model)
    try:
        for name, layer in found.items():
            _put(model, name, layer.merged())
        yield
    finally:
        for name, layer in found.items():
            _put(model, name, layer)


def save_adapters(model: nn.Module, shape: LoraShape, folder: Path) -> None:
    """Write the adapters into a folder, with what they are adapters of. Raises OSError."""
    found = adapters(model)
    tensors = {name: {"down": layer.down.detach(), "up": layer.up.detach()} for name, layer in found.items()}
    torch.save(tensors, folder / _WEIGHTS)
    described = {"shape": asdict(shape), "frozen": _digest(list(found.values()))}
    (folder / _DESCRIPTION).write_text(json.dumps(described), encoding="utf-8")


def has_adapters(folder: Path) -> bool:
    """Whether ``save_adapters`` wrote there."""
    return (folder / _DESCRIPTION).is_file()


def load_adapters(model: nn.Module, shape: LoraShape, folder: Path) -> None:
    """Put saved adapters into a model that was adapted alike. Raises TrainerError where they are others'."""
    try:
        described = json.loads((folder / _DESCRIPTION).read_text(encoding="utf-8"))
        told = {**described["shape"], "targets": tuple(described["shape"]["targets"])}
        frozen = described["frozen"]
        tensors = torch.load(folder / _WEIGHTS, map_location="cpu", weights_only=True)
    except DAMAGE as error:
        raise TrainerError(
            f"the adapters in {folder} are damaged ({reason_of(error)}): use another checkpoint"
        ) from error
    if told != asdict(shape):
        raise TrainerError(
            f"the adapters in {folder} have {told}, the settings say {asdict(shape)}: resume with the settings of the run"
        )
    found = adapters(model)
    if set(found) != set(tensors) or frozen != _digest(list(found.values())):
        raise TrainerError(
            f"the adapters in {folder} belong to another model than the one that is loaded: put back the model that the run "
            "started from, or start a new run"
        )
    with torch.no_grad():
        for name, layer in found.items():
            layer.down.copy_(tensors[name]["down"])
            layer.up.copy_(tensors[name]["up"])


def _digest(layers: Sequence[LoraLinear]) -> str:
    """Tells models apart by the first and the last adapted layer's frozen weights."""
    digest = hashlib.sha256()
    for layer in (layers[0], layers[-1]):
        digest.update(layer.inner.weight.detach().float().cpu().numpy().tobytes())
    return digest.hexdigest()


def _put(model: nn.Module, name: str, layer: nn.Module) -> None:
    parent, _, last = name.rpartition(".")
    setattr(model.get_submodule(parent), last, layer)
