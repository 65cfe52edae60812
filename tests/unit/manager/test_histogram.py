"""Histogram quantiles and Prometheus buckets."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.manager.histogram import BOUNDS_S, Histogram, merged
from embomatrix.manager.observe.run_figures import FIRST_STEP_S, STEPS, Series

between_bounds = st.floats(1e-4, 500.0).filter(
    lambda value: all(abs(value / bound_s - 1) > 1e-9 for bound_s in BOUNDS_S)
)
durations = st.lists(between_bounds, min_size=1, max_size=200)


def histogram_of(values):
    histogram = Histogram()
    for value in values:
        histogram.observe(value)
    return histogram


@given(durations, st.sampled_from([0.5, 0.95, 0.99]))
def test_quantile_error_is_at_most_four_percent(values, share):
    exact = sorted(values)[max(0, math.ceil(share * len(values)) - 1)]
    assert histogram_of(values).quantile(share) == pytest.approx(exact, rel=0.04)


@given(durations)
def test_prometheus_buckets_are_exact_up_to_rounding(values):
    assert histogram_of(values).cumulative() == [
        sum(value <= bound_s for value in values) for bound_s in BOUNDS_S
    ]


@given(durations, durations)
def test_merging_loses_nothing(first, second):
    both, one = merged([histogram_of(first), histogram_of(second)]), histogram_of(first + second)
    assert (both.counts, both.count) == (one.counts, one.count)
    assert both.sum_s == pytest.approx(one.sum_s)


@pytest.mark.parametrize("value", [0.0, -1e-9, 1e9])
def test_duration_beyond_the_buckets_is_counted_at_their_end(value):
    assert sum(histogram_of([value]).counts) == 1


def test_empty_histogram_has_quantile_zero():
    assert Histogram().quantile(0.99) == 0.0


@given(st.lists(st.floats(0.0, 1e5), max_size=50))
def test_series_keeps_every_count_in_bounded_memory(times):
    series = Series(10.0)
    for at_s in sorted(times):
        series.count(10.0 + at_s, completed=2, failed=1)
    values = series.values()
    assert (sum(values.completed), sum(values.failed)) == (2 * len(times), len(times))
    assert len(values.completed) <= STEPS
    assert math.log2(values.step_s / FIRST_STEP_S).is_integer()
