"""Models to evaluate: a run, one of its checkpoints, a saved policy, or any Hugging Face model."""

from pathlib import Path
from typing import Final

import torch

from embomatrix.skills.prompt import Codec
from embomatrix.starter.shipped import SHIPPED, shipped_policy
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import (
    LANGUAGE_MODEL_DEFAULTS,
    LoraSettings,
    TrainSettings,
    read_settings,
)
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, newest_checkpoint, read_state
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.limits import ANSWER_TOKENS
from embomatrix.trainer.policy.loading import configure_torch, saved_policy
from embomatrix.trainer.policy.protocol import Policy
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.world.task import MAX_TABLE

_OPEN_LIMITS: Final = {"prompt.rows": MAX_TABLE, "grpo.max_new": ANSWER_TOKENS}


def load_model(
    named: str, codec: Codec | None, *, threads: int | None, device: str
) -> tuple[Policy, TrainSettings]:
    """Load a policy with its settings. Raises TrainerError.

    The folder of a run stands for its newest checkpoint, and ``shipped`` for the policy that ships with the package. A trained
    policy keeps its codec; any other model uses ``codec``, by default JSON. A model without the settings of a run gets the
    limits of an endpoint: the whole object table, and ``ANSWER_TOKENS``.
    """
    folder = shipped_policy() if named == SHIPPED else Path(named)
    if (folder / CHECKPOINTS).is_dir():
        folder = newest_checkpoint(folder) or folder
    if folder.is_dir() and (folder / "policy").is_dir():
        _, settings = read_state(folder)
        # A checkpoint holds the merged model, so the base model of its adapters is not needed.
        settings = settings.model_copy(update={"device": device, "lora": LoraSettings()})
        configure_torch(threads or settings.threads, device)
        return saved_policy(folder / "policy", settings, learns=False), settings
    configure_torch(threads or torch.get_num_threads(), device)
    if folder.is_dir() and TinyPolicy.is_saved_in(folder):
        settings = read_settings(None, {"device": device, **_OPEN_LIMITS})
        return saved_policy(folder, settings, learns=False), settings
    if folder.is_dir() and not HfPolicy.is_saved_in(folder):
        raise TrainerError(
            f"{folder} is not a model: expected runs/NAME, one of its checkpoints (runs/NAME/checkpoints/step-000050), or a "
            "folder with config.json"
        )
    written = codec or HfPolicy.codec_in(folder) or Codec.JSON
    given = {"device": device, "codec": written, **_OPEN_LIMITS}
    settings = read_settings(None, given, LANGUAGE_MODEL_DEFAULTS)
    return HfPolicy.load(named, settings, learns=False), settings
