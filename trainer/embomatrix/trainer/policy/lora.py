"""Low-rank adapters (LoRA, Hu et al. 2021) of Hugging Face models, by peft.

Optimiser state and gradients have the size of the adapters, and the reference policy shares the frozen weights.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import torch
from torch import nn

from embomatrix.trainer.config.errors import DAMAGE, TrainerError, reason_of

if TYPE_CHECKING:
    from embomatrix.trainer.config.settings import LoraSettings

ADAPTERS: Final = "adapter"
"""Subfolder of a saved policy in peft's own format. The folder itself holds the merged model."""
_BASE_DIGEST: Final = "base_model.sha256"


def add_adapters(model: Any, settings: LoraSettings, *, seed: int) -> Any:
    """Freeze ``model`` and put adapters on its linear layers. New adapters leave its output unchanged.

    Raises TrainerError if peft is missing or no layer matches ``settings.targets``.
    """
    try:
        from peft import LoraConfig, get_peft_model
    except ImportError as error:
        raise TrainerError(
            "lora.rank needs peft: `pip install 'embomatrix[hf]'`, or leave lora out"
        ) from error
    targets: Any = list(settings.targets) or "all-linear"
    options: dict[str, Any] = {"r": settings.rank, "lora_alpha": settings.alpha, "target_modules": targets}
    config: Any = LoraConfig(**options)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            return get_peft_model(model, config)
        except ValueError as error:
            raise TrainerError(
                f"lora.targets: the model has no linear layer named {' or '.join(settings.targets)}: expected last parts of "
                "layer names, such as q_proj; an empty list adapts all layers"
            ) from error


def save_adapters(model: Any, folder: Path) -> None:
    """Save the adapters in peft's format, with a digest of the base model. Raises OSError."""
    model.save_pretrained(folder / ADAPTERS)
    (folder / ADAPTERS / _BASE_DIGEST).write_text(_base_digest(model), encoding="utf-8")


def has_adapters(folder: Path) -> bool:
    """True if ``save_adapters`` wrote to the folder."""
    return (folder / ADAPTERS / _BASE_DIGEST).is_file()


def load_adapters(model: Any, folder: Path) -> None:
    """Load saved adapters into a model with adapters of the same shape.

    Raises TrainerError if they are damaged, of another shape, or belong to another base model.
    """
    from peft import LoraConfig, load_peft_weights, set_peft_model_state_dict
    from safetensors import SafetensorError

    saved = folder / ADAPTERS
    try:
        found: Any = LoraConfig.from_pretrained(str(saved))
        digest = (saved / _BASE_DIGEST).read_text(encoding="utf-8")
        tensors = load_peft_weights(str(saved), device="cpu")
    except (SafetensorError, *DAMAGE) as error:
        raise TrainerError(
            f"the adapters in {saved} are damaged ({reason_of(error)}): use another checkpoint"
        ) from error
    wanted = model.peft_config["default"]
    shapes = [(config.r, config.lora_alpha, config.target_modules) for config in (found, wanted)]
    if shapes[0] != shapes[1]:
        raise TrainerError(
            f"the adapters in {saved} have rank {found.r} and alpha {found.lora_alpha:g}, the settings say {wanted.r} and "
            f"{wanted.lora_alpha:g}, or the targets differ: resume with the settings of the run"
        )
    if digest != _base_digest(model):
        raise TrainerError(
            f"the adapters in {saved} belong to another model than the one that is loaded: restore the model that the run "
            "started from, or start a new run"
        )
    set_peft_model_state_dict(model, tensors)


def _base_digest(model: nn.Module) -> str:
    """SHA-256 of the first and the last adapted layer's frozen weights."""
    frozen = [weight for name, weight in model.named_parameters() if name.endswith("base_layer.weight")]
    digest = hashlib.sha256()
    for weight in (frozen[0], frozen[-1]):
        digest.update(weight.detach().float().cpu().numpy().tobytes())
    return digest.hexdigest()
