"""Creation and loading of policies by model name or folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import torch

from embomatrix.trainer.config.errors import DAMAGE, TrainerError, reason_of
from embomatrix.trainer.config.settings import TrainSettings
from embomatrix.trainer.policy.compute_dtype import torch_dtype
from embomatrix.trainer.policy.decoder import DecoderShape
from embomatrix.trainer.policy.hf import HfPolicy, attention_window
from embomatrix.trainer.policy.lora import has_adapters
from embomatrix.trainer.policy.protocol import Policy
from embomatrix.trainer.policy.tiny import EPISODE_CONTEXT, TinyPolicy
from embomatrix.trainer.policy.vocabulary import Vocabulary, build_vocabulary

if TYPE_CHECKING:
    from embomatrix.trainer.data.tasks import TaskSet

TINY: Final = "tiny"


def configure_torch(threads: int, device: str) -> None:
    """Set torch's threads and check its device. Raises TrainerError if torch does not support the device."""
    torch.set_num_threads(threads)
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise TrainerError(
            f"the device {device!r} can't be used ({reason_of(error)}): expected cpu, or cuda with a GPU"
        ) from error


def is_word_level(model: str) -> bool:
    """True for the word-level policy, new (``tiny``) or saved in a folder."""
    return model == TINY or TinyPolicy.is_saved_in(Path(model))


def new_policy(settings: TrainSettings, tasks: TaskSet) -> Policy:
    """Create the initial policy of a run. Raises TrainerError if the model is unknown or can't be loaded."""
    if not is_word_level(settings.model):
        return _language_model(settings.model, settings)
    if settings.model != TINY:
        check_word_level(settings)
        policy = saved_policy(Path(settings.model), settings)
        _check_form(policy, settings)
        return policy
    vocabulary, shape = word_level_shape(settings, tasks)
    return TinyPolicy(
        vocabulary,
        shape,
        seed=settings.seed,
        device=settings.device,
        compute_dtype=torch_dtype(settings.compute_dtype, settings.device),
        single_calls=settings.episodes.visibility is not None,
    )


def _check_form(policy: Policy, settings: TrainSettings) -> None:
    """Raise TrainerError if a saved policy writes whole plans and the run has episodes, or the other way round."""
    in_episodes = settings.episodes.visibility is not None
    if isinstance(policy, TinyPolicy) and policy.single_calls is not in_episodes:
        found, remedy = (
            ("the calls of episodes", "set") if policy.single_calls else ("whole plans", "leave out")
        )
        raise TrainerError(
            f"the policy in {settings.model} writes {found}: {remedy} episodes.visibility, or pass another --model"
        )


def check_word_level(settings: TrainSettings) -> None:
    """Raise TrainerError if settings of Hugging Face models are given for the word-level policy."""
    if settings.lora.rank or settings.gradient_checkpointing or settings.sampler.url:
        raise TrainerError(
            "lora, gradient_checkpointing and sampler.url are for Hugging Face models, not for the word-level policy: leave "
            "them out"
        )


def word_level_shape(settings: TrainSettings, tasks: TaskSet) -> tuple[Vocabulary, DecoderShape]:
    """Return the vocabulary and the shape of a word-level policy, new or saved, without its weights. Raises TrainerError."""
    check_word_level(settings)
    if settings.model != TINY:
        try:
            vocabulary, shape, _ = TinyPolicy.described_in(Path(settings.model))
        except DAMAGE as error:
            raise _damaged(Path(settings.model), error) from error
        return vocabulary, shape
    situations = [task.situation for task in (*tasks.train, *tasks.heldout)]
    in_episodes = settings.episodes.visibility is not None
    instructions = [task.task.instruction for task in tasks.train]
    vocabulary = build_vocabulary(situations, instructions, in_episodes=in_episodes)
    shape = DecoderShape(len(vocabulary), **settings.tiny.model_dump())
    return vocabulary, replace(shape, longest=EPISODE_CONTEXT) if in_episodes else shape


def _damaged(folder: Path, error: BaseException) -> TrainerError:
    return TrainerError(f"the policy in {folder} is damaged ({reason_of(error)}): use another checkpoint")


def saved_policy(folder: Path, settings: TrainSettings, *, learns: bool = True) -> Policy:
    """Load a policy from a folder, to train it unless ``learns`` is False.

    Raises TrainerError if there is none, or it is damaged.
    """
    try:
        if TinyPolicy.is_saved_in(folder):
            compute_dtype = torch_dtype(settings.compute_dtype, settings.device)
            return TinyPolicy.load(folder, device=settings.device, compute_dtype=compute_dtype)
    except DAMAGE as error:
        raise _damaged(folder, error) from error
    if settings.lora.rank and has_adapters(folder):
        return _language_model(settings.model, settings, folder)
    if HfPolicy.is_saved_in(folder):
        return HfPolicy.load(folder, settings, label=settings.model, learns=learns)
    raise TrainerError(
        f"no policy found in {folder}: pass a checkpoint folder such as runs/NAME/checkpoints/step-000050"
    )


def _language_model(named: str, settings: TrainSettings, adapters: Path | None = None) -> HfPolicy:
    """Load a Hugging Face model, with new or saved adapters if the settings ask for them. Raises TrainerError."""
    policy = HfPolicy.load(named, settings)
    in_episodes = settings.episodes.visibility is not None
    if policy.in_episodes and not in_episodes:
        raise TrainerError(
            f"the model in {named} writes the calls of episodes: set episodes.visibility, or pass another --model"
        )
    window = attention_window(policy.module)
    if in_episodes and window is not None and window < (policy.context or window + 1):
        raise TrainerError(
            f"the model {named} has layers that attend to the last {window:,} tokens only, fewer than its context of "
            f"{policy.context or 'any length'}: episodes need layers that attend to all; pass another --model, or leave "
            "episodes.visibility out"
        )
    policy.in_episodes = in_episodes
    if settings.lora.rank:
        policy.adapt(settings.lora, seed=settings.seed, saved=adapters)
    return policy
