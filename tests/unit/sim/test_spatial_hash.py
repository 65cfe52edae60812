"""The spatial hash finds the same boxes as an exhaustive comparison."""

from hypothesis import given, settings
from hypothesis import strategies as st

from embomatrix.sim.geometry.spatial_hash import SpatialHash
from embomatrix.world.geometry import Aabb

PLACE = st.tuples(*[st.floats(-40.0, 40.0)] * 3)
SIZE = st.tuples(*[st.floats(0.0, 20.0)] * 3)


def box_at(low, size) -> Aabb:
    return Aabb(low, tuple(edge + extent for edge, extent in zip(low, size, strict=True)))


BOX = st.builds(box_at, PLACE, SIZE)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 8), st.none() | BOX), max_size=30), BOX, st.floats(0.0, 1.0))
def test_near_boxes_equal_those_of_an_exhaustive_comparison(changes, asked, reach_m) -> None:
    around, boxes = SpatialHash(), {}
    for number, box in changes:
        if box is None:
            around.take_out(number)
            boxes.pop(number, None)
        else:
            around.put(number, box)
            boxes[number] = box
    grown = asked.grown(reach_m)
    assert around.near(asked, reach_m) == sorted(n for n, box in boxes.items() if box.overlaps(grown))
