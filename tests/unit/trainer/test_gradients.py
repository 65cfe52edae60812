"""Gradients of microbatches: bit-identical sums in any order of arrival."""

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from embomatrix.trainer.grpo.gradients import GradientSum

PARTS = [torch.tensor([scale, 1 / scale, 0.1]) for scale in (1e7, 3.0, 1e-7, 0.3, 1e3)]


def summed(order, tensors=PARTS):
    weights, idle = nn.Parameter(torch.zeros(3)), nn.Parameter(torch.zeros(2))
    gradients = GradientSum([weights, idle])
    most = 0
    for part in order:
        gradients.add(part, lambda part=part: (weights * tensors[part]).sum().backward())
        most = max(most, gradients.stored)
    assert gradients.stored == 0
    assert idle.grad is None
    return weights.grad, most


@given(st.permutations(range(len(PARTS))))
def test_sum_is_bit_identical_for_any_order(order):
    assert torch.equal(summed(order)[0], summed(range(len(PARTS)))[0])


@given(st.permutations(range(len(PARTS))), st.sets(st.sampled_from(range(len(PARTS)))))
def test_remote_gradients_give_the_same_sum(order, elsewhere):
    weights, idle = nn.Parameter(torch.zeros(3)), nn.Parameter(torch.zeros(2))
    gradients = GradientSum([weights, idle])
    for part in order:
        if part in elsewhere:
            gradients.put(part, [PARTS[part].clone(), None])
        else:
            gradients.add(part, lambda part=part: (weights * PARTS[part]).sum().backward())
    assert torch.equal(weights.grad, summed(range(len(PARTS)))[0])
    assert idle.grad is None


def test_early_gradients_are_stored():
    assert summed([0, 1, 2, 3, 4])[1] == 0
    assert summed([4, 3, 2, 1, 0])[1] == 4


def test_microbatch_without_a_gradient_is_counted():
    weights = nn.Parameter(torch.zeros(3))
    gradients = GradientSum([weights])
    gradients.add(1, lambda: weights.sum().backward())
    gradients.add(0, lambda: None)
    assert gradients.next_index == 2
    gradients.scale(0.5)
    assert weights.grad.tolist() == [0.5, 0.5, 0.5]
