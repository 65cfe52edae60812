"""The robot's centre may stand wherever its radius reaches no covered cell."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import ndimage

from embomatrix.sim.floor.grid import CELL_M, clear_floor
from embomatrix.skills.limits import ROBOT

FLOORS = arrays.arrays(
    np.int16,
    st.tuples(st.integers(1, 24), st.integers(1, 24)),
    elements=st.integers(1, 3),
    fill=st.just(0),
)


@given(FLOORS)
def test_clear_cells_are_a_radius_from_every_covered_one(covered):
    free = covered == 0
    distances = ndimage.distance_transform_edt(free) if not free.all() else np.full(free.shape, np.inf)
    assert np.array_equal(clear_floor(covered), distances * CELL_M >= ROBOT.radius_m)


def test_one_covered_cell_blocks_a_disc():
    covered = np.zeros((15, 15), np.int16)
    covered[7, 7] = 1
    blocked = ~clear_floor(covered)
    assert blocked.sum(axis=0).tolist() == [0, 0, 5, 7, 9, 11, 11, 11, 11, 11, 9, 7, 5, 0, 0]
