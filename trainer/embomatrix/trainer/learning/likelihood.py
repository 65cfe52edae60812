"""Likelihood of given plans: the loss of imitation."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from embomatrix.trainer.policy.protocol import Policy, Tokens

Example = tuple[Tokens, Tokens]
"""Prompt and plan."""


def plan_tokens(examples: Sequence[Example]) -> int:
    """Return the number of plan tokens in the examples."""
    return sum(len(plan) for _, plan in examples)


def negative_log_likelihood(policy: Policy, examples: Sequence[Example]) -> Tensor:
    """Return the negative log-likelihood of the plans in nats, summed over their tokens."""
    prompts, plans = zip(*examples, strict=True)
    tokens = pad_sequence([torch.tensor(plan) for plan in plans], batch_first=True)
    mask = pad_sequence([torch.ones(len(plan), dtype=torch.bool) for plan in plans], batch_first=True)
    device = next(iter(policy.parameters())).device
    scored = policy.logprobs(prompts, tokens.to(device), mask.to(device), group=1, temperature=1.0)
    return -scored.logprobs.sum()
