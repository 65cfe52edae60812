"""Log-probabilities and entropies of tokens from a language model's hidden states, without all scores at once.

The scores of all tokens over the vocabulary are the largest tensor of an update: 8 plans of 512 tokens over 152,000 words
have 2.5 GB in float32. The output layer therefore runs on chunks of the tokens, and again in the backward pass.
"""

from __future__ import annotations

import functools
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from embomatrix.trainer.policy.protocol import token_entropy

SCORES_PER_CHUNK: Final = 2**25
"""Largest number of scores (tokens times vocabulary) that are computed at once: 128 MiB in float32."""


def chunked_scores(
    head: Any, states: Tensor, tokens: Tensor, temperature: float, *, entropy_gradient: bool
) -> tuple[Tensor, Tensor]:
    """Return log-probability and entropy (n,) of tokens (n,) after states (n, C).

    ``head`` is the output layer, or ``nn.Identity`` if ``states`` are scores (n, V) already.
    """
    score = functools.partial(_scores, head, temperature=temperature, entropy_gradient=entropy_gradient)
    vocabulary = states.shape[-1] if isinstance(head, nn.Identity) else len(head.weight)
    size = max(1, SCORES_PER_CHUNK // vocabulary)
    chunks = list(zip(torch.split(states, size), torch.split(tokens, size), strict=True))
    if len(chunks) > 1 and torch.is_grad_enabled():
        # The backward pass computes each chunk's scores again. One chunk is small enough to keep.
        score = functools.partial(checkpoint, score, use_reentrant=False, preserve_rng_state=False)
    chosen, entropy = zip(*(score(*chunk) for chunk in chunks), strict=True)
    return torch.cat(chosen), torch.cat(entropy)


def _scores(
    head: nn.Module, states: Tensor, tokens: Tensor, *, temperature: float, entropy_gradient: bool
) -> tuple[Tensor, Tensor]:
    distribution = torch.log_softmax(head(states).float() / (temperature or 1.0), dim=-1)  # (n, V)
    chosen = distribution.gather(-1, tokens[:, None])[:, 0]
    return chosen, token_entropy(distribution, gradient=entropy_gradient)


@torch.no_grad()
def has_plain_head(model: Any) -> bool:
    """True if the model's scores are its output layer on its decoder's hidden states.

    Some families scale or cap the scores afterwards (Gemma 2, Granite, Cohere), under different names in their
    configurations. The function therefore compares the scores of two tokens.
    """
    ids = torch.tensor([[0, 1]], device=model.device)
    try:
        states = model.get_decoder()(ids, use_cache=False).last_hidden_state
        scores = model.get_output_embeddings()(states)
    except (AttributeError, TypeError, RuntimeError):  # no such parts, or they don't fit together
        return False
    return torch.equal(scores, model(ids, use_cache=False).logits)
