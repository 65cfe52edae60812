"""Advantages of single answers, among those that episodes of a task gave in equal states.

GiGPO, Feng et al. 2025 (arXiv 2505.10978). If answer t = 1 ... n of an episode changes its reward by g_t, the *return* of
answer t is the sum over k = t ... n of discount ** (k - t) * g_k, so rewards and costs before the state don't count. Answers
of a task that were given in equal states are a group of their own, and the *step advantage* is their return, centred and
scaled within that group as rewards are in GRPO. An answer in a state that no other answer met has 0. The advantage of a token
is that of its episode, plus ``weight`` times the step advantage of its answer.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from embomatrix.trainer.learning.objective import group_advantages


@dataclass(frozen=True, slots=True)
class StepRule:
    """Weight of the step advantage, and discount of changes of the reward with each answer before them."""

    weight: float
    discount: float


@dataclass(frozen=True, slots=True)
class AnswerStates:
    """State before each answer of each episode, in the order of the samples. Hold the states of different tasks apart."""

    rule: StepRule
    states: Sequence[Sequence[Hashable]]
    rewards_before: Sequence[Sequence[float]]
    """Reward of the episode before each answer."""

    def of(self, rows: slice) -> AnswerStates:
        """Return those of some episodes."""
        return AnswerStates(self.rule, self.states[rows], self.rewards_before[rows])

    def step_advantages(self, rewards: Tensor, floor: float) -> Tensor:
        """Return the step advantages (episodes, answers) of one task's episodes, padded with 0.

        ``rewards``: (episodes,), NaN for lost episodes. ``floor`` is added to the standard deviations.
        """
        met: dict[Hashable, list[tuple[int, int]]] = {}
        for episode, states in enumerate(self.states):
            for answer, state in enumerate(states):
                met.setdefault(state, []).append((episode, answer))
        values = torch.zeros(len(self.states), max((len(states) for states in self.states), default=0))
        groups = [places for places in met.values() if len(places) > 1]
        if not groups:
            return values
        by_episode = [
            self._returns(*each) for each in zip(self.rewards_before, rewards.tolist(), strict=True)
        ]
        returns = [
            torch.tensor([by_episode[episode][answer] for episode, answer in places]) for places in groups
        ]
        found = group_advantages(pad_sequence(returns, True, torch.nan), floor).values  # (states, answers)
        for places, row in zip(groups, found, strict=True):
            episodes, answers = zip(*places, strict=True)
            values[episodes, answers] = row[: len(places)]
        return values

    def _returns(self, before: Sequence[float], reward: float) -> list[float]:
        """Return the return of each answer of an episode with this reward; NaN if the episode was lost."""
        following, returns = 0.0, []
        for earlier, later in reversed([*itertools.pairwise([*before, reward])]):
            following = later - earlier + self.rule.discount * following
            returns.append(following)
        return returns[::-1]

    def token_advantages(self, rewards: Tensor, advantages: Tensor, mask: Tensor, floor: float) -> Tensor:
        """Return the advantages (episodes, tokens) of one task's tokens.

        ``advantages`` are those of the episodes: (episodes,). ``mask`` (episodes, tokens) is true on the policy's own tokens.
        Each answer is one run of them, because the policy is told something between any two.
        """
        steps = self.step_advantages(rewards, floor)  # (episodes, answers)
        begins = mask.clone()
        begins[:, 1:] &= ~mask[:, :-1]
        answer = (begins.cumsum(dim=1) - 1).clamp(min=0)  # (episodes, tokens)
        own = steps.to(mask.device).gather(1, answer) if steps.shape[1] else torch.zeros_like(answer)
        return torch.where(mask, advantages[:, None] + self.rule.weight * own, 0.0)
