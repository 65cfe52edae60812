"""Intervals over tasks, pass@k, and the one cause of each failure."""

import math

import numpy as np
import pytest

from embomatrix.pages.figures import wilson
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.parse import PlanReason, parse_plan
from embomatrix.skills.trace import Step
from embomatrix.skills.view import refuse
from embomatrix.trainer.evaluation.intervals import IntervalMethod, mean_over_tasks, pass_at
from embomatrix.trainer.evaluation.taxonomy import (
    MEANINGS,
    PLAN_CAUSES,
    REMEDIES,
    STEP_CAUSES,
    Cause,
    cause_of_trace,
)

TABLE = ("fridge_1", "apple_1", "table_1", "microwave_1", "bowl_1")


def failed(plan, at, reason, **words):
    """Return steps of a plan whose step ``at``, counted from 1, fails as the simulator would report it."""
    steps = [Step(call, None, "") for call in plan[: at - 1]]
    refusal = refuse(reason, **words)
    return (*steps, Step(plan[at - 1], reason, refusal.sentence, refusal.blocker))


def test_wilson_interval_equals_the_textbook_value():
    interval = wilson(0.1, 20)  # Newcombe 1998, table I: 2 of 20
    assert (interval.low, interval.high) == pytest.approx((0.0279, 0.3010), abs=1e-3)


def test_equal_tasks_give_a_wilson_interval():
    nothing = mean_over_tasks([0.0] * 20)
    assert nothing.method is IntervalMethod.WILSON
    assert nothing.interval.low == pytest.approx(0.0)
    assert 0.1 < nothing.interval.high < 0.2


def test_bootstrap_resamples_tasks_not_samples():
    """Ten equal samples of each of ten tasks are ten observations, not a hundred."""
    estimate = mean_over_tasks([0.0, 1.0] * 5)
    assert estimate.method is IntervalMethod.BOOTSTRAP
    assert estimate.interval.high - estimate.interval.low > 0.5


def test_unknown_task_is_left_out():
    estimate = mean_over_tasks([1.0, math.nan, 0.5])
    assert (estimate.tasks, estimate.interval.value) == (2, 0.75)
    assert mean_over_tasks([math.nan]).method is IntervalMethod.NONE


def test_pass_at_k_is_the_share_of_draws_with_a_success():
    rng = np.random.default_rng(0)
    draws = [rng.permutation(10)[:3].min() < 2 for _ in range(20_000)]  # samples 0 and 1 succeed
    assert pass_at(3, 10, 2) == pytest.approx(np.mean(draws), abs=0.01)
    assert pass_at(1, 10, 2) == pytest.approx(0.2)
    assert pass_at(10, 10, 1) == 1.0
    assert math.isnan(pass_at(11, 10, 2))


def test_every_failure_reason_has_one_cause():
    assert set(STEP_CAUSES) | set(REMEDIES) == set(FailureReason)
    assert not set(STEP_CAUSES) & set(REMEDIES)


def test_every_plan_reason_has_a_cause_and_every_cause_a_meaning():
    assert set(PLAN_CAUSES) == set(PlanReason)
    assert set(MEANINGS) == set(Cause)


@pytest.mark.parametrize(
    ("plan", "at", "reason", "words", "cause"),
    [
        (
            "move 1; pick_up 1; place 0 inside",
            3,
            "container_closed",
            {"container": "fridge_1"},
            "missing_step",
        ),
        (
            "move 1; pick_up 1; place 0 inside; open 0",
            3,
            "container_closed",
            {"container": "fridge_1"},
            "wrong_order",
        ),
        (
            "move 1; pick_up 1; place 0 inside; open 3",
            3,
            "container_closed",
            {"container": "fridge_1"},
            "missing_step",
        ),
        (
            "open 0; close 0; pick_up 1",
            3,
            "out_of_reach",
            {"target": "apple_1", "distance": "2.1", "limit": "0.9"},
            "missing_step",
        ),
        (
            "pick_up 1; move 1",
            1,
            "out_of_reach",
            {"target": "apple_1", "distance": "2.1", "limit": "0.9"},
            "wrong_order",
        ),
        ("pick_up 1; pick_up 4; place 2 ontop", 2, "hand_full", {"held": "apple_1"}, "wrong_order"),
        ("pick_up 1; pick_up 4", 2, "hand_full", {"held": "apple_1"}, "missing_step"),
        (
            "pick_up 4; pick_up 1",
            1,
            "supports_others",
            {"target": "bowl_1", "other": "apple_1"},
            "wrong_order",
        ),
        ("move 99", 1, "unknown_index", {"index": 99, "last": 4}, "hallucinated_object"),
        ("pick_up 0", 1, "not_portable", {"target": "fridge_1"}, "affordance"),
        ("open 0; open 0", 2, "already_open", {"target": "fridge_1"}, "additional_step"),
        ("move 1", 1, "no_path", {"target": "apple_1", "other": "table_1"}, "unreachable"),
    ],
)
def test_first_failed_step_decides_the_cause(plan, at, reason, words, cause):
    calls = parse_plan(plan)
    assert cause_of_trace(calls, failed(calls, at, FailureReason(reason), **words), TABLE) == cause


def test_complete_plan_without_success_has_the_cause_goal_not_met():
    plan = parse_plan("move 1")
    assert cause_of_trace(plan, [Step(plan[0], None, "")], TABLE) is Cause.GOAL_NOT_MET
