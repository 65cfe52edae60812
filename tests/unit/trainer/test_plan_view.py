"""Marks of a plan's steps on the plan view."""

import math

from hypothesis import given
from hypothesis import strategies as st

from embomatrix.trainer.evaluation.plan_view import MARK_PX, apart

POINTS = st.lists(st.tuples(st.integers(0, 560), st.integers(0, 430)), max_size=40)


@given(POINTS)
def test_no_mark_covers_another_one_and_lone_marks_stay_at_their_objects(points):
    placed = apart(points)
    for at, place in enumerate(placed):
        assert all(math.dist(place, other) >= 2 * MARK_PX for other in placed[:at])
        if all(math.dist(points[at], other) >= 2 * MARK_PX for other in placed[:at]):
            assert place == points[at]


def test_steps_at_one_object_stand_in_reading_order():
    first, second, third, *_ = apart([(100, 100)] * 9)
    assert (first, second) == ((100, 100), (100 + 2 * MARK_PX, 100))
    assert third[0] >= second[0] or third[1] > first[1]
