"""Muon in float32: singular values near 1, and the same weights as torch's up to bfloat16's rounding."""

import pytest
import torch
from torch import nn

from embomatrix.trainer.imitation.muon import Muon, orthogonalised

SHAPES = [(8, 8), (48, 16), (16, 48), (1, 5), (384, 128)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_singular_values_come_near_one_and_directions_stay(shape):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    left, before, right = torch.linalg.svd(matrix, full_matrices=False)
    inside = left.t() @ orthogonalised(matrix) @ right.t()
    turned = inside - torch.diag(torch.diag(inside))
    assert turned.abs().max() < 1e-3
    seen = before > 2e-2 * before.norm()  # five iterations don't lift the smallest ones
    assert seen.any()
    assert (torch.diag(inside)[seen] > 0.6).all()
    assert (torch.diag(inside) < 1.25).all()


def test_a_zero_gradient_gives_no_direction():
    assert torch.equal(orthogonalised(torch.zeros(3, 4)), torch.zeros(3, 4))


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_equals_torchs_muon_up_to_its_rounding(shape):
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(shape, generator=generator)
    ours, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    optimisers = (
        Muon([ours], lr=0.02, weight_decay=0.01),
        torch.optim.Muon([theirs], lr=0.02, weight_decay=0.01),
    )
    for _ in range(5):
        gradient = torch.randn(shape, generator=generator)
        for parameter, optimiser in zip((ours, theirs), optimisers, strict=True):
            parameter.grad = gradient.clone()
            optimiser.step()
    moved = (theirs - start).norm()
    assert (ours - theirs).norm() < 0.03 * moved
    assert moved > 0


def test_a_matrix_without_a_gradient_stays():
    matrix = nn.Parameter(torch.ones(2, 2))
    Muon([matrix], lr=1.0, weight_decay=0.5).step()
    assert torch.equal(matrix, torch.ones(2, 2))
