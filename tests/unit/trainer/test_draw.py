"""Token sampling: frequencies follow the scores, and masked tokens are never drawn."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.trainer.policy.protocol import draw

MASKED_SCORE = -1e9


@pytest.mark.parametrize("temperature", [0.5, 1.0, 1.7])
def test_token_frequencies_follow_the_softmax(temperature):
    scores = torch.tensor([2.0, MASKED_SCORE, 0.0, 1.0, -1.0, MASKED_SCORE])
    count = 40_000
    choice, logprob = draw(scores.repeat(count, 1), temperature, torch.Generator().manual_seed(0))
    expected = torch.softmax(scores / temperature, dim=0)
    assert torch.allclose(torch.bincount(choice, minlength=6) / count, expected, atol=0.01)
    assert torch.allclose(logprob, expected.log()[choice])


@given(
    masked=st.lists(st.booleans(), min_size=2, max_size=40).filter(lambda marks: not all(marks)),
    seed=st.integers(0, 2**32),
)
def test_masked_token_is_never_drawn(masked, seed):
    generator = torch.Generator().manual_seed(seed)
    marks = torch.tensor(masked)
    scores = torch.randn(len(masked), generator=generator).masked_fill(marks, MASKED_SCORE)
    choice, _ = draw(scores.repeat(50, 1), 1.0, generator)
    assert not marks[choice].any()


def test_temperature_zero_is_greedy():
    scores = torch.tensor([[0.1, 0.3, 0.2], [5.0, MASKED_SCORE, 1.0]])
    choice, _ = draw(scores, 0.0, torch.Generator())
    assert choice.tolist() == [1, 0]
