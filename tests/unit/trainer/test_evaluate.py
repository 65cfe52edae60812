"""Held-out evaluation: intervals over tasks, paired differences, lost rollouts left out."""

import math

import numpy as np
import pytest

from embomatrix.trainer.evaluation.held_out import HeldOutEvaluation, TaskScore, improvement
from embomatrix.trainer.evaluation.intervals import bootstrap, over_seeds_and_tasks


def scored(successes, samples=10, prefix="t", category="pick_and_place"):
    return HeldOutEvaluation(
        tuple(
            TaskScore(f"{prefix}{at}", category, samples, count, 10 - samples)
            for at, count in enumerate(successes)
        )
    )


def test_interval_contains_the_mean_and_narrows_with_more_tasks():
    few, many = scored([0, 10] * 5).success(), scored([0, 10] * 50).success()
    assert few.low < few.value == many.value == 0.5 < few.high
    assert many.high - many.low < few.high - few.low


def test_interval_has_its_nominal_coverage():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        interval = bootstrap(list(rng.binomial(10, rng.beta(2, 3, size=40)) / 10))
        hits += interval.low <= 0.4 <= interval.high
    assert 0.88 <= hits / 200 <= 0.99


def test_paired_difference_is_significant_within_both_intervals():
    before, after = scored([0, 2, 8, 9] * 10), scored([1, 3, 9, 10] * 10)
    assert before.success().high > after.success().low
    change = improvement(before, after)
    assert change.value == pytest.approx(0.1)
    assert change.low > 0


def test_interval_over_seeds_and_tasks_is_wider_than_over_tasks_if_seeds_differ():
    rng = np.random.default_rng(0)
    tasks = rng.normal(0, 0.3, size=100)
    alike = [{f"t{at}": value for at, value in enumerate(tasks)} for _ in range(5)]
    apart = [
        {name: value + shift for name, value in alike[0].items()} for shift in (-0.2, -0.1, 0.0, 0.1, 0.2)
    ]
    one, both = over_seeds_and_tasks(alike), over_seeds_and_tasks(apart)
    expected = bootstrap(list(tasks))
    assert one.value == pytest.approx(expected.value) == both.value
    assert one.high - one.low == pytest.approx(expected.high - expected.low, rel=0.1)
    assert both.high - both.low > 1.5 * (one.high - one.low)


def test_only_tasks_that_all_seeds_know_count():
    found = over_seeds_and_tasks([{"a": 1.0, "b": 0.0}, {"a": 1.0, "b": math.nan, "c": 0.0}])
    assert (found.value, found.low, found.high) == (1.0, 1.0, 1.0)
    assert math.isnan(over_seeds_and_tasks([]).value)
    assert math.isnan(over_seeds_and_tasks([{"a": 1.0}, {"b": 1.0}]).value)


@pytest.mark.parametrize("tasks", [1, 2, 20, 200])
def test_equal_differences_leave_room_for_tasks_that_were_not_seen(tasks):
    change = improvement(scored([5] * tasks), scored([5] * tasks))
    assert change.value == 0
    assert change.high == -change.low == pytest.approx(1 - 0.025 ** (1 / tasks))
    best = improvement(scored([0] * tasks), scored([10] * tasks))
    assert (best.value, best.high) == (1, 1)
    assert best.low == pytest.approx(1 - 2 * change.high)


def test_only_common_tasks_are_paired():
    assert improvement(scored([0, 0]), scored([10, 10, 10])).value == 1.0
    assert math.isnan(improvement(scored([5]), scored([5], prefix="other")).value)


def test_task_with_only_lost_rollouts_is_left_out():
    known = scored([5, 5])
    lost = scored([0], samples=0, prefix="lost")
    assert HeldOutEvaluation((*known.scores, *lost.scores)).success().value == 0.5


def test_categories_are_reported_separately():
    both = HeldOutEvaluation((*scored([10]).scores, *scored([0], prefix="c", category="compound").scores))
    assert both.categories == ("compound", "pick_and_place")
    assert both.success("compound").value == 0
    assert both.success("pick_and_place").value == 1


def test_scores_survive_a_json_round_trip():
    result = scored([1, 2, 3])
    assert HeldOutEvaluation.from_json(result.as_json()) == result
