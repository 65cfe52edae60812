"""Lines of approach between obstacles."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.sim.floor.obstacles import Obstacles, crosses
from embomatrix.world.geometry import Aabb

COORDINATE = st.floats(-1.0, 1.0)
PARTS = st.tuples(COORDINATE, COORDINATE, COORDINATE, st.integers(-1, 3), st.booleans())


@given(st.lists(PARTS, min_size=1, max_size=12), COORDINATE, COORDINATE, COORDINATE, COORDINATE, COORDINATE)
def test_line_is_blocked_exactly_by_the_blockers_of_its_end(parts, x, y, to_x, to_y, low) -> None:
    rows = [(a, b, a + 0.3, b + 0.3, low_z, low_z + 0.8) for a, b, low_z, _, _ in parts]
    owners = np.array([owner for _, _, _, owner, _ in parts], dtype=np.int32)
    obstacles = Obstacles(np.array(rows), owners, np.array([panel for *_, panel in parts]))
    box, own = Aabb((to_x, to_y, low), (to_x + 0.1, to_y + 0.1, low + 0.1)), (0, 1, 2)
    expected = crosses((x, y), (to_x, to_y), obstacles.blockers(box, own))
    assert obstacles.block_line((x, y), (to_x, to_y), box, own) == expected
