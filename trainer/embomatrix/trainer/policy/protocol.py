"""Interface between the trainer and a policy of any size: sample plans, score them, save."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from embomatrix.skills.prompt import Codec, Prompt

Tokens = tuple[int, ...]


class ImitationExample(NamedTuple):
    """Prompt and plan to imitate, or prompt and the rest of an episode.

    ``observed`` is true on tokens of observations, which have no loss; empty: there are none. The first ``policy_tokens``
    tokens come from answers of the policy itself and are not imitated either.
    """

    prompt: Tokens
    plan: Tokens
    observed: tuple[bool, ...] = ()
    policy_tokens: int = 0

    @property
    def imitated(self) -> int:
        """Number of tokens that are imitated."""
        return len(self.plan) - self.policy_tokens - sum(self.observed[self.policy_tokens :])


@dataclass(frozen=True, slots=True)
class Samples:
    """``group`` completions per prompt: row q * group + i is sample i of prompt q.

    ``tokens``, ``mask`` and ``logprobs`` have shape (rows, longest completion). ``mask`` is true up to and including the
    end token. In an episode it is true on the tokens of the policy's answers and false on the observations between
    them. Log-probabilities are at the sampling temperature. ``cut_off`` (rows,) is true for completions that reached the
    maximum length without an end token.
    """

    tokens: Tensor
    mask: Tensor
    logprobs: Tensor
    texts: tuple[str, ...]
    cut_off: Tensor


@dataclass(frozen=True, slots=True)
class TokenScores:
    """Log-probability of each token and entropy of its distribution, both (rows, tokens).

    The entropy has a gradient only on request: its graph holds several tensors of the size of all scores.
    """

    logprobs: Tensor
    entropy: Tensor


class Policy(Protocol):
    """Causal language model that writes plans in one codec."""

    @property
    def name(self) -> str: ...

    @property
    def codec(self) -> Codec: ...

    @property
    def module(self) -> nn.Module: ...

    @property
    def context(self) -> int | None:
        """Maximum tokens of a prompt and a plan together. None: no limit is known."""
        ...

    def encode(self, prompt: Prompt) -> Tokens:
        """Return the tokens of a prompt, up to where the plan begins."""
        ...

    def encode_plan(self, text: str) -> Tokens:
        """Return the tokens of a plan with its end token: the target of imitation."""
        ...

    def encode_answer(self, text: str) -> Tokens:
        """Return the tokens of an answer in an episode with its end token: the target of imitation."""
        ...

    def encode_observation(self, text: str) -> Tokens:
        """Return the tokens of an observation between two answers of an episode."""
        ...

    def unknown_words(self, text: str) -> frozenset[str]:
        """Return the words of a plan that the policy can't write."""
        ...

    def sample(
        self,
        prompts: Sequence[Tokens],
        group: int,
        temperature: float,
        max_new: int,
        generator: torch.Generator,
    ) -> Samples:
        """Draw ``group`` completions per prompt. Temperature 0 is greedy decoding."""
        ...

    def logprobs(
        self,
        prompts: Sequence[Tokens],
        tokens: Tensor,
        mask: Tensor,
        group: int,
        temperature: float,
        *,
        entropy_gradient: bool = False,
    ) -> TokenScores:
        """Score completions in the layout of ``Samples``. Log-probabilities have gradients, the entropy on request."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]: ...

    def frozen_copy(self) -> Policy:
        """Return a copy without gradients: the reference policy of the KL term."""
        ...

    def save(self, folder: Path) -> None: ...


def draw(scores: Tensor, temperature: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw one token per row; return tokens and log-probabilities, both (rows,). scores: (rows, V).

    Temperature 0 is greedy. Inverse transform sampling needs one random number per row: one per token, as in the Gumbel
    trick, costs more than the rest of this function.
    """
    scaled = scores / (temperature or 1.0)
    logprobs = torch.log_softmax(scaled, dim=-1)
    if temperature == 0:
        choice = logprobs.argmax(dim=-1, keepdim=True)
    else:
        cumulative = torch.softmax(scaled, dim=-1).cumsum(dim=-1)  # (rows, V)
        total = cumulative[:, -1:]
        drawn = torch.rand(total.shape, generator=generator, dtype=total.dtype, device=total.device)
        # Strictly below the total: where rounding makes them equal, the search would return a masked token.
        below = torch.minimum(drawn * total, torch.nextafter(total, torch.zeros_like(total)))
        choice = torch.searchsorted(cumulative, below, right=True)
    return choice[:, 0], logprobs.gather(-1, choice)[:, 0]


def token_entropy(logprobs: Tensor, *, gradient: bool, minimum: float | None = None) -> Tensor:
    """Return the entropy (...) of each distribution (..., V). Lower log-probabilities count as ``minimum``."""
    with torch.set_grad_enabled(gradient and torch.is_grad_enabled()):
        bounded = logprobs if minimum is None else logprobs.clamp(min=minimum)
        return -(bounded.exp() * bounded).sum(dim=-1)


def written_lengths(mask: Tensor) -> Tensor:
    """Return the number of tokens up to each row's last one of its own (rows,). mask: (rows, T), true on own tokens."""
    places = torch.arange(1, mask.shape[1] + 1, device=mask.device)
    return (mask * places).amax(dim=1)


def pad_left(prompts: Sequence[Tokens], fill: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return prompts as token rows that end together, and their padding mask; both (prompts, longest)."""
    rows = [torch.tensor(prompt) for prompt in prompts]
    real = [torch.ones(len(prompt), dtype=torch.bool) for prompt in prompts]
    tokens = pad_sequence(rows, batch_first=True, padding_value=fill, padding_side="left")
    padding = ~pad_sequence(real, batch_first=True, padding_side="left")
    return tokens.to(device), padding.to(device)
