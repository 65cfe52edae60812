"""What the trainer needs of a policy, whatever its size: sample plans, give their log-probabilities, be saved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    import torch
    from torch import Tensor, nn

    from embomatrix.skills.prompt import Codec, Prompt

Tokens = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Samples:
    """``group`` completions of each prompt, prompt by prompt: row q * group + i is sample i of prompt q.

    ``tokens``, ``mask`` and ``logprobs`` have shape (rows, longest completion). ``mask`` is true up to and with the end
    token. Log-probabilities are at the temperature of sampling.
    """

    tokens: Tensor
    mask: Tensor
    logprobs: Tensor
    texts: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Scored:
    """Log-probability of each token and entropy of each position, both (rows, tokens)."""

    logprobs: Tensor
    entropy: Tensor


class Policy(Protocol):
    """A causal language model with the codec that its plans are written in."""

    @property
    def name(self) -> str: ...

    @property
    def codec(self) -> Codec: ...

    @property
    def module(self) -> nn.Module: ...

    def encode(self, prompt: Prompt) -> Tokens:
        """Tokens of a prompt, up to where the plan begins."""
        ...

    def encode_plan(self, text: str) -> Tokens:
        """Tokens of a plan with its end token: what imitation teaches after the prompt."""
        ...

    def sample(
        self,
        prompts: Sequence[Tokens],
        group: int,
        temperature: float,
        max_new: int,
        generator: torch.Generator,
    ) -> Samples:
        """Draw ``group`` completions of each prompt; temperature 0 takes the likeliest token."""
        ...

    def logprobs(
        self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor, group: int, temperature: float
    ) -> Scored:
        """Score completions laid out as in ``Samples``, with gradients."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]: ...

    def frozen_copy(self) -> Policy:
        """The policy as it is now, without gradients: the reference of the KL term."""
        ...

    def save(self, folder: Path) -> None: ...
