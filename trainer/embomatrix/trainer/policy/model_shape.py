"""Sizes of a Hugging Face model, from its config.json alone. transformers is imported on first use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from embomatrix.trainer.config.errors import TrainerError, reason_of
from embomatrix.trainer.policy.footprint import LanguageModelShape, Matrix
from embomatrix.trainer.policy.hf import CONFIG, REMEDY, HfPolicy, check_on_hub


def language_model_shape(name: str) -> LanguageModelShape:
    """Return the sizes of a model, by name or folder. Weights and tokenizer are not read. Raises TrainerError."""
    try:
        from transformers import AutoConfig, AutoModelForCausalLM

        models: Any = AutoModelForCausalLM  # transformers leaves it untyped
        if not HfPolicy.is_saved_in(Path(name)):
            if Path(name).is_dir():
                raise TrainerError(f"the model folder {name} has no {CONFIG}: {REMEDY}")
            check_on_hub(name)
    except ImportError as error:
        raise TrainerError(
            f"the memory of the model {name!r} needs transformers: `pip install 'embomatrix[hf]'`, or pass tiny"
        ) from error
    try:
        config: Any = AutoConfig.from_pretrained(name)
        with torch.device("meta"):  # shapes without memory
            model: Any = models.from_config(config)
        return shape_of(model)
    except Exception as error:  # readers of configurations raise their own errors
        raise TrainerError(
            f"the {CONFIG} of the model {name!r} can't be used ({reason_of(error)}): {REMEDY}"
        ) from error


def shape_of(model: Any) -> LanguageModelShape:
    """Return the sizes of a causal language model of transformers, whose tensors may be on the device ``meta``."""
    config = model.config.get_text_config()
    head = model.get_output_embeddings()
    matrices = tuple(
        Matrix(path.rpartition(".")[2], layer.in_features, layer.out_features)
        for path, layer in model.named_modules()
        if isinstance(layer, torch.nn.Linear) and layer is not head
    )
    width, heads = int(config.hidden_size), int(config.num_attention_heads)
    return LanguageModelShape(
        parameters=sum(parameter.numel() for parameter in model.parameters()),
        vocabulary=int(config.vocab_size),
        layers=int(config.num_hidden_layers),
        width=width,
        inner=int(getattr(config, "intermediate_size", None) or 4 * width),
        heads=heads,
        key_value_heads=int(getattr(config, "num_key_value_heads", None) or heads),
        head_width=int(getattr(config, "head_dim", None) or width // heads),
        matrices=matrices,
        tied=head is not None and head.weight is model.get_input_embeddings().weight,
    )
