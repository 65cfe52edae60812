"""Episodes of any policy, played side by side."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from embomatrix.trainer.policy.chat_rows import ChatRows
from embomatrix.trainer.policy.episode_rows import EpisodeRows
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.protocol import Policy, Tokens
from embomatrix.trainer.policy.tiny import TinyPolicy


def plays_episodes(policy: Policy) -> bool:
    """Return True for a policy that was trained in episodes."""
    if isinstance(policy, TinyPolicy):
        return policy.single_calls
    return isinstance(policy, HfPolicy) and policy.in_episodes


def rows_of_episodes(
    policy: Policy, prompts: Sequence[Tokens], group: int, temperature: float, seed: int, longest: int
) -> EpisodeRows | ChatRows:
    """Begin ``group`` episodes for each prompt. Answers of a language model have at most ``longest`` tokens."""
    generator = torch.Generator(next(iter(policy.parameters())).device).manual_seed(seed)
    if isinstance(policy, HfPolicy):
        return ChatRows(policy, prompts, group, temperature, generator, longest)
    assert isinstance(policy, TinyPolicy), "no other policy plays episodes"
    return EpisodeRows(policy, prompts, group, temperature, generator)
