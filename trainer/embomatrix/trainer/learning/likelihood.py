"""Likelihood of given plans: the loss of imitation."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from embomatrix.trainer.policy.protocol import ImitationExample, Policy


def plan_tokens(examples: Sequence[ImitationExample]) -> int:
    """Return the number of tokens in the examples that are imitated."""
    return sum(example.imitated for example in examples)


def negative_log_likelihood(policy: Policy, examples: Sequence[ImitationExample]) -> Tensor:
    """Return the negative log-likelihood of the plans in nats, summed over the tokens that are imitated."""
    tokens = pad_sequence([torch.tensor(example.plan) for example in examples], batch_first=True)
    mask = pad_sequence([_own(example) for example in examples], batch_first=True)
    first = torch.tensor([example.policy_tokens for example in examples])
    imitated = torch.arange(tokens.shape[1]) >= first[:, None]
    device = next(iter(policy.parameters())).device
    prompts = [example.prompt for example in examples]
    scored = policy.logprobs(prompts, tokens.to(device), mask.to(device), group=1, temperature=1.0)
    return -(scored.logprobs * imitated.to(device)).sum()


def _own(example: ImitationExample) -> Tensor:
    return ~torch.tensor(example.observed or (False,) * len(example.plan), dtype=torch.bool)
