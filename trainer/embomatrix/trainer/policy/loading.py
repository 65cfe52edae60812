"""From a model's name to a policy, new or saved."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.trainer.config.errors import DAMAGE, TrainerError, reason_of
from embomatrix.trainer.policy.compute_dtype import type_of
from embomatrix.trainer.policy.decoder import DecoderShape
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.lora import LoraShape, has_adapters
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.policy.vocabulary import build_vocabulary

if TYPE_CHECKING:
    from embomatrix.trainer.config.settings import TrainSettings
    from embomatrix.trainer.data.tasks import TaskSet
    from embomatrix.trainer.policy.protocol import Policy

TINY: Final = "tiny"


def is_tiny(model: str) -> bool:
    """Whether a model by name or folder is the from-scratch policy, new or saved."""
    return model == TINY or TinyPolicy.is_saved_in(Path(model))


def new_policy(settings: TrainSettings, tasks: TaskSet) -> Policy:
    """The policy that a run starts from. Raises TrainerError where the model is unknown or can't be loaded."""
    if not is_tiny(settings.model):
        return _language_model(settings.model, settings)
    if settings.lora.rank or settings.gradient_checkpointing:
        raise TrainerError(
            "lora and gradient_checkpointing are for Hugging Face models: the word-level policy needs neither, leave them out"
        )
    if settings.model != TINY:
        return saved_policy(Path(settings.model), settings)
    situations = [task.situation for task in (*tasks.train, *tasks.heldout)]
    vocabulary = build_vocabulary(situations, [task.task.instruction for task in tasks.train])
    shape = DecoderShape(len(vocabulary), **settings.tiny.model_dump())
    return TinyPolicy(
        vocabulary,
        shape,
        seed=settings.seed,
        device=settings.device,
        products=type_of(settings.products, settings.device),
    )


def saved_policy(folder: Path, settings: TrainSettings) -> Policy:
    """A policy that was saved in a folder. Raises TrainerError where there is none."""
    try:
        if TinyPolicy.is_saved_in(folder):
            products = type_of(settings.products, settings.device)
            return TinyPolicy.load(folder, device=settings.device, products=products)
    except DAMAGE as error:
        raise TrainerError(
            f"the policy in {folder} is damaged ({reason_of(error)}): use another checkpoint"
        ) from error
    if settings.lora.rank and has_adapters(folder):
        return _language_model(settings.model, settings, folder)
    if HfPolicy.is_saved_in(folder):
        return HfPolicy.load(
            folder,
            settings.codec,
            device=settings.device,
            products=settings.products,
            label=settings.model,
            recompute=settings.gradient_checkpointing,
        )
    raise TrainerError(
        f"there is no policy in {folder}: pass a checkpoint folder, runs/NAME/checkpoints/step-000050"
    )


def _language_model(named: str, settings: TrainSettings, adapters: Path | None = None) -> HfPolicy:
    """A Hugging Face model, with adapters where the settings want them: new ones, or those of a folder."""
    policy = HfPolicy.load(
        named,
        settings.codec,
        device=settings.device,
        products=settings.products,
        recompute=settings.gradient_checkpointing,
    )
    if settings.lora.rank:
        shape = LoraShape(settings.lora.rank, settings.lora.alpha, settings.lora.targets)
        policy.adapt(shape, seed=settings.seed, saved=adapters)
    return policy
