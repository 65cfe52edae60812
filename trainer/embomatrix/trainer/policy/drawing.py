"""Drawing a token from scores."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


def draw(scores: Tensor, temperature: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """One token per row and its log-probability; scores: (rows, V). Temperature 0 takes the likeliest.

    One random number a row says how far along the summed probabilities the token lies: one for each word costs more than all
    else here.
    """
    scaled = scores / (temperature or 1.0)
    logprobs = torch.log_softmax(scaled, dim=-1)
    if temperature == 0:
        choice = logprobs.argmax(dim=-1, keepdim=True)
    else:
        along = torch.softmax(scaled, dim=-1).cumsum(dim=-1)
        whole = along[:, -1:]
        drawn = torch.rand(whole.shape, generator=generator, dtype=whole.dtype, device=whole.device)
        # Below the whole, or a word that is barred would be taken where rounding makes them equal.
        below = torch.minimum(drawn * whole, torch.nextafter(whole, torch.zeros_like(whole)))
        choice = torch.searchsorted(along, below, right=True)
    return choice[:, 0], logprobs.gather(-1, choice)[:, 0]
