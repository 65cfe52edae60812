"""Figures in words."""

from embomatrix.pages.figures import Interval


def test_a_difference_of_nearly_nothing_has_no_sign():
    assert Interval(-0.0001, -0.118, 0.0002).as_percent() == "0.0% [-11.8%, 0.0%]"
