"""Drawing a token from scores."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


def draw(scores: Tensor, temperature: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """One token per row and its log-probability; scores: (rows, V). Temperature 0 takes the likeliest.

    The Gumbel trick draws exactly from the softmax and needs no cumulative sum.
    """
    logprobs = torch.log_softmax(scores / (temperature or 1.0), dim=-1)
    if temperature == 0:
        choice = logprobs.argmax(dim=-1)
    else:
        noise = torch.empty_like(logprobs).exponential_(generator=generator).log()
        choice = (logprobs - noise).argmax(dim=-1)
    return choice, logprobs.gather(-1, choice[:, None])[:, 0]
