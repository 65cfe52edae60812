"""Step advantages: answers in equal states are compared with each other, and only with each other."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.trainer.grpo.step_advantages import AnswerStates, StepRule
from embomatrix.trainer.learning.objective import group_advantages

RULE = StepRule(weight=1.0, discount=0.5)
STATES = st.lists(st.lists(st.sampled_from("abcd"), max_size=5), min_size=2, max_size=5)
REWARD = st.sampled_from([0.5, 0.7, 31.2, math.nan])


def answers(states, rule=RULE):
    """Return the answers of episodes whose reward comes at their end."""
    return AnswerStates(rule, states, [[0.0] * len(each) for each in states])


def test_answer_that_led_to_the_goal_in_fewer_answers_is_better_than_its_alternatives():
    # From "room" the first episode goes straight to the goal, the second takes two answers more, the third fails.
    states = [["start", "room"], ["start", "room", "hall", "kitchen"], ["start", "room"]]
    values = answers(states).step_advantages(torch.tensor([8.0, 8.0, 0.0]), floor=0.0)
    returns = torch.tensor([[4.0, 1.0, 0.0], [8.0, 2.0, 0.0]])  # of "start" and of "room", by episode
    expected = group_advantages(returns, 0.0).values
    assert torch.allclose(values[:, 0], expected[0])
    assert torch.allclose(values[:, 1], expected[1])
    assert values[0, 1] > values[1, 1] > values[2, 1]
    assert values[1, 2:].tolist() == [0, 0]  # nobody else was in the hall or the kitchen


def test_rewards_and_costs_before_a_state_do_not_count_in_it():
    # Both episodes do the same from "room" on; the second came there after failures that cost it 0.5.
    states = [["start", "room", "goal"], ["start", "start", "start", "room", "goal"]]
    before = [[0.0, 1.0, 1.5], [0.0, -0.25, -0.5, 0.5, 1.0]]
    values = AnswerStates(RULE, states, before).step_advantages(torch.tensor([31.5, 31.0]), floor=1e-4)
    assert values[0, 1:].abs().sum() == values[1, 3:].abs().sum() == 0
    assert values[0, 0] == values[1, 2] > values[1, 1] > values[1, 0]


def test_state_that_an_episode_meets_twice_compares_its_own_answers():
    values = answers([["a", "a", "b"], ["c"]]).step_advantages(torch.tensor([4.0, 4.0]), floor=0.0)
    assert values[0, 0] == -values[0, 1] < 0
    assert values[0, 2] == values[1, 0] == 0


@given(states=STATES, data=st.data())
def test_lost_episodes_have_no_part(states, data):
    rewards = data.draw(st.lists(REWARD, min_size=len(states), max_size=len(states)))
    values = answers(states).step_advantages(torch.tensor(rewards), floor=1.0)
    known = [row for row, reward in enumerate(rewards) if not math.isnan(reward)]
    alone = answers([states[row] for row in known])
    expected = alone.step_advantages(torch.tensor([rewards[row] for row in known]), floor=1.0)
    width = expected.shape[1]
    assert torch.allclose(values[known][:, :width], expected, atol=1e-6)
    assert values[known][:, width:].abs().sum() == 0
    assert values[[row for row in range(len(states)) if row not in known]].abs().sum() == 0
    for state in "abcd":
        places = [(row, at) for row in known for at, each in enumerate(states[row]) if each == state]
        assert sum(float(values[place]) for place in places) == pytest.approx(0, abs=1e-4)


def test_tokens_have_the_advantage_of_their_episode_and_of_their_answer():
    own = torch.tensor([[1, 1, 0, 0, 1, 0, 1, 1], [1, 0, 1, 1, 0, 0, 0, 0]]).bool()
    states = answers([["a", "b", "c"], ["a", "b"]], StepRule(weight=2.0, discount=0.5))
    rewards, episodes = torch.tensor([1.0, 3.0]), torch.tensor([-0.7, 0.7])
    steps = states.step_advantages(rewards, floor=0.5).tolist()
    tokens = states.token_advantages(rewards, episodes, own, floor=0.5)
    first, second = [-0.7 + 2 * steps[0][at] for at in range(3)], [0.7 + 2 * steps[1][at] for at in range(2)]
    assert tokens[0].tolist() == pytest.approx([first[0], first[0], 0, 0, first[1], 0, first[2], first[2]])
    assert tokens[1].tolist() == pytest.approx([second[0], 0, second[1], second[1], 0, 0, 0, 0])


def test_episodes_without_an_answer_have_none():
    states = answers([[], []])
    tokens = states.token_advantages(torch.zeros(2), torch.zeros(2), torch.zeros(2, 3).bool(), floor=1.0)
    assert tokens.shape == (2, 3)
    assert not tokens.any()
