"""Cavities of imported models: one per compartment, none for the space beside a round wall."""

from __future__ import annotations

import numpy as np
import pytest

from embomatrix.factory.importers.cavities import CELLS, cavities


def test_round_hollow_is_one_cavity() -> None:
    x, y = np.meshgrid(np.arange(CELLS) - 19.5, np.arange(CELLS) - 19.5, indexing="ij")
    solid = np.repeat((np.hypot(x, y) > 17)[:, :, None], CELLS, axis=2)
    solid[:, :, :2] = True
    (inside,) = cavities(solid, (0.4, 0.4, 0.4))
    assert min(inside.box.size_m[:2]) > 0.2


def test_small_bay_beside_a_large_one_is_a_separate_cavity() -> None:
    solid = np.zeros((CELLS,) * 3, dtype=np.bool_)
    for axis in (0, 1, 2):
        solid[(slice(None),) * axis + ((0, 1, -2, -1),)] = True
    solid[:, 30:32] = True
    small, large = sorted(cavities(solid, (0.4, 0.4, 0.4)), key=lambda found: found.box.size_m[1])
    assert small.box.size_m[1] == pytest.approx(0.06)
    assert large.box.size_m[1] == pytest.approx(0.28)
